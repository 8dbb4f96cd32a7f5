"""Transforms, which make training examples of samples: resize, crop, flip, colour.

RGB, thermal, label, its confidence and the map of source positions always move together. Masking
is in `rgbt.maskers`; padding to a multiple of 32 is done by networks and losses
(`rgbt.geometry.padding`). The files of ``conf/transform/`` say what each setting is.
"""
