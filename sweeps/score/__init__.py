"""What finished runs, weights and predictions score in the cells of a table."""
