"""Transforms, which make training examples of samples: resize, crop, flip, colour.

The files of ``conf/transform/`` say what each setting is; networks and losses pad the examples.
"""
