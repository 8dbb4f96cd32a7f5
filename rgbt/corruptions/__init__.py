"""Corruptions of images, each with a severity: missing, hidden, noisy, blurred, late, shifted.

A corruption is chosen by its file in ``conf/corruption/``; `rgbt.evaluation.request` is a
data set seen under it.
"""
