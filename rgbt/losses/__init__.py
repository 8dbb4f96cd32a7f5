"""Losses, with labels and without: pure functions and settings that `rgbt.schemes` combines."""
