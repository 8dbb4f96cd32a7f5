"""Maskers, which draw the hidden cells of RGB and thermal in a training step.

`masker` has the one class that every file of conf/masker/ configures, `sketch` draws examples of
it. Not here: the mask token (models).
"""
