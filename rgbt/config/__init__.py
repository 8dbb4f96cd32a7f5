"""Configuration: composed by Hydra, checked, and the command line."""
