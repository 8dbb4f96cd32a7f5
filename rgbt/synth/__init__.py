"""The embedded world: synthetic RGB-thermal driving scenes with exact labels.

Scenes are placed in 3-D, projected and shaded with NumPy and OpenCV, then written in the layouts of
real data sets, so that all later code is shared with them. This is not a simulator: nothing moves.
"""
