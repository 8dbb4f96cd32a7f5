"""Corruptions of images, each with a severity: missing, hidden, noisy, blurred, late, shifted."""
