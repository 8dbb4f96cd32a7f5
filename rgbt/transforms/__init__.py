"""From a sample to an example: resizing, cropping, flipping, colour.

RGB, thermal, label, its confidence and the map of source positions always move together. Masking
is in `rgbt.maskers`; padding to a multiple of 32 is done by networks and losses
(`rgbt.geometry.padding`).
"""
