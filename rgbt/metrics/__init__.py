"""Count (region, label, prediction), and derive every score from these counts.

`regions` cuts the image, `metric` is the configured choice, `confusion` counts, `counts` stores,
`scores` derives, `names` holds every metric name once. Not here: running a network.
"""
