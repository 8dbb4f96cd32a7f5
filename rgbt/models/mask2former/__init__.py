"""RGB-T Mask2Former: two Swin branches with mask tokens, fusion, pixel decoder, query decoder.

Parameter names are those of the released CRM and SpatialSeg checkpoints without their leading
`network.`. Not here: matching and losses (`rgbt.losses`), weight files, masks (`rgbt.maskers`).
"""
