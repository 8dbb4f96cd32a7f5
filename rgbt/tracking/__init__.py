"""Write the run folder, send it to MLflow, draw pictures, and print tables.

The folder is the source of truth. MLflow is filled from it, also later. Nothing here computes a
score or decides how a run continues.
"""
