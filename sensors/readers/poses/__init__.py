"""Bodies and markers as trackers and trajectories have them."""
