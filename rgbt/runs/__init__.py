"""Specification, key, name and upstream runs of a run."""
