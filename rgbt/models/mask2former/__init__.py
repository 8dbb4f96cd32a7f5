"""RGB-T Mask2Former: `model.Mask2Former`; any backbone with its head: `network.MaskNetwork`."""
