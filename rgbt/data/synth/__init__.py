"""Synthetic RGB-thermal driving scenes with exact labels: the embedded default data set.

Scenes are placed in 3-D, projected and shaded with NumPy and OpenCV, then written in MFNet's own
layout, so that everything after the files is shared with real data. Not a simulator: nothing moves.
"""
