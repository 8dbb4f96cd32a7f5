"""Build the objects of a run from its specification, and load finished runs."""
