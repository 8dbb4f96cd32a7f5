"""Prepares the files of a data set from a download: ``python -m rgbt.data.prepare``."""
