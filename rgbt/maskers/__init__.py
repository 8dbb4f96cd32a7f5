"""Maskers, which draw the hidden cells of RGB and thermal in a training step.

`pattern` draws the cells of one mask, `pairing` says how the two masks relate, `masker` joins them
into the one class that every file of conf/masker/ configures. Not here: the mask token (models).
"""
