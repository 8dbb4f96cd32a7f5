"""The results of runs as small files in the repository."""
