"""CMX: two Mix Transformer streams that rectify each other, their fusion and an MLP decoder.

Parameter names are those of the CMX release, which the temporal release's files share except for
an unused layer (`voting`). Not here: losses (`rgbt.losses`), weight files.
"""
