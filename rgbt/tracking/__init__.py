"""What a run leaves behind: its folder, MLflow filled from that folder, pictures, terminal tables.

The folder is the source of truth. MLflow is filled from it, also later; nothing here computes a
score or decides how a run continues.
"""
