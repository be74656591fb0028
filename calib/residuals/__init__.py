"""What should be zero, and its derivative by site: one file per residual."""
