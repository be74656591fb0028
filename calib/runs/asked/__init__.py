"""What is asked of runs that are there: what moved between two, their numbers as tables."""
