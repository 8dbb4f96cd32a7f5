"""CMX: `model.CMX`; what it shares with CMNeXt: `network.CmxNetwork`."""
