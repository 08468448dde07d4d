"""The YAML file that says what is built and run."""
