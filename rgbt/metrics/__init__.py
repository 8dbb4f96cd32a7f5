"""Counts of (region, label, prediction) and every score that is derived from them.

`regions` cuts the image, `metric` is the configured choice, `confusion` counts, `counts` stores,
`scores` derives, `names` holds every metric name once. Not here: running a network.
"""
