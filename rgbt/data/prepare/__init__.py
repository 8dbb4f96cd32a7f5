"""Prepare the files of a data set from a download: ``rgbt prepare``."""
