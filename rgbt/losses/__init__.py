"""Losses of predictions, with labels and without.

With labels: set criterion, cross-entropy, self-distillation. Without: maximum squares, entropy,
adversarial. Losses are pure functions and frozen settings; `rgbt.schemes` combines them.
"""
