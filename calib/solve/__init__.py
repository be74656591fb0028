"""The GTSAM graph, and the loop of the fit."""
