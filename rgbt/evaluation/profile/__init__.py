"""Measure networks side by side: their size, operations, memory and time of a prediction."""
