"""StitchFusion without the data sets that its package imports."""

from rgbt.models.external.adapting import skip_init


def network(**arguments):
    """Build the network."""
    skip_init("semseg")
    from semseg.models.stitchfusion import stitchfusion

    return stitchfusion(**arguments)
