"""Images that are missing or partly wrong: a kind of failure with a severity.

A failure is chosen by its file in ``conf/degradation/``; `dataset.Degraded` is a data set under it.
"""
