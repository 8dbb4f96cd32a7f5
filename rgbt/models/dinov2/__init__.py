"""Plain vision transformers of DINOv2's form for RGB and thermal images, with Mask2Former's head.

Parameter names of the encoder are those of the published DINOv2 files. Not here: losses
(`rgbt.losses`), weight files (`rgbt.checkpoints`).
"""
