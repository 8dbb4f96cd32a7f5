"""Count (region, label, prediction), and derive every score from these counts."""
