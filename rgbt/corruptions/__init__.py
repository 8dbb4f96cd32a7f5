"""Images that are missing or partly wrong, each kind of corruption with a severity.

A corruption is chosen by its file in ``conf/corruption/``; `rgbt.evaluation.corrupted_dataset` is a
data set seen under it.
"""
