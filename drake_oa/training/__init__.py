"""Training of the regressor chain: data set, Levenberg-Marquardt, validation."""
