"""Tables as files, their cells as points, and what is scored of the runs."""
