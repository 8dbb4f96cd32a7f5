"""Statistics of a data set by region: occupancy, Laplacian variance, signal to noise, entropy.

Source: SpatialSeg, Sec. III-B and III-C. An image is measured by `measure`, a split by `collect`;
`resampled` derives the quantities, `statements` judges what the paper says about them.
"""
