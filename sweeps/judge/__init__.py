"""What the runs of a table say about the claims of its paper, and which scores are the best."""
