"""Count (region, label, prediction), and derive every score from these counts.

`metric` is the configured partition, `counting` counts, `counts` stores, `scores` derives, `named`
computes a score by its name (`names`). Not here: running a network.
"""
