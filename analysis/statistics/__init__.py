"""Statistics of a data set by region: occupancy, Laplacian variance, signal to noise, entropy.

Source: SpatialSeg, Sec. III-B and III-C. Measured once (`collect`), stored (`data`), everything
else derived (`derive`, `claims`); nothing is drawn here.
"""
