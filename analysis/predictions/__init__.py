"""Predicted label images of any method, counted by region (`scoring`) and by pixel (`maps`)."""
