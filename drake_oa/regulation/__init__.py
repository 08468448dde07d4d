"""The coupling terms' parameters: the regressor chain, and the search that verifies it."""
