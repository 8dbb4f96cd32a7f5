"""Checks of data sets and their report, which `rgbt.data.check` prints."""
