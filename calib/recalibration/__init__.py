"""What moved since an earlier run, whose solution is the prior of a fit to newer data."""
