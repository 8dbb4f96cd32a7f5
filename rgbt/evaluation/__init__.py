"""Evaluate a trained network: segmentation, consistency, corruptions, pseudo-labels."""
