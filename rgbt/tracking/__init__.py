"""What a run leaves behind: its folder, MLflow filled from that folder, pictures, terminal tables.

The folder is the truth. MLflow is a view of it that can be filled later; nothing here computes a
score or decides how a run goes on.
"""
