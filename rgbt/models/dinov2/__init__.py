"""Plain vision transformers of DINOv2 and DINOv3 for RGB-thermal images, with Mask2Former's head.

The package is named after the first of them, because stored runs name its module. Parameter names
of the encoder are those of the published files. Not here: losses
(`rgbt.losses`), weight files (`rgbt.checkpoints`).
"""
