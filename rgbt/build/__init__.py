"""The objects of a run, built from its specification; a finished run opened again."""
