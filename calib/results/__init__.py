"""What an estimate says: frames and effects, their errors, what fits and what was not told."""
