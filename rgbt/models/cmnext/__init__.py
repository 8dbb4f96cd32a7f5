"""CMNeXt for RGB and thermal: a MiT stream for RGB, a pooling stream for thermal.

The rest is CMX's: what lies between the streams, and the decoder. Not here: the self-query hub,
which exists from three modalities on, losses (`rgbt.losses`), weight files.
"""
