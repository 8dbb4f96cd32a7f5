"""Plain vision transformers of DINOv2 and DINOv3 with Mask2Former's head: `model`."""
