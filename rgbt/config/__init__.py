"""Compose the configuration with Hydra, check it, and parse the command line."""
