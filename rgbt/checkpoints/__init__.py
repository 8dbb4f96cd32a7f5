"""Files of tensors: written with a digest, read as data within a budget, never executed.

`stored.read_stored` -> the value of a file, ours or foreign; `stored.save` writes one of ours.
"""
