"""DeepLab v2 with one head or one per domain: `model.DeepLabV2` is the network."""
