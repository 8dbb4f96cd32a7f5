"""Generate synthetic RGB-thermal driving scenes with exact labels: the embedded data sets.

Scenes are placed in 3-D, projected and shaded with NumPy and OpenCV, then written in MFNet's own
layout, so that all later code is shared with real data. This is not a simulator: nothing moves.
"""
