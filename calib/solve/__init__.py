"""The GTSAM graph, the loop of the fit, covariance, and stops that were held out."""
