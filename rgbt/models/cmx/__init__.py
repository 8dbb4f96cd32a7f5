"""CMX: `model.CMX`, and `model.CmxNetwork`, which it shares with CMNeXt."""
