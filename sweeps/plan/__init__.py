"""What was requested, a table or points, and the runs that it needs."""
