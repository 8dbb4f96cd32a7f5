"""Schemes, which define the passes and losses of one training step as phases."""
