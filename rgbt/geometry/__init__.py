"""Geometry of pixels: padded sizes, and the views of a turned camera (homography, warp)."""
