"""Who runs what: points in a study, drivers, processes, results found again."""
