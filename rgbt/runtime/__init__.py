"""Handle signals, and processes of one run."""
