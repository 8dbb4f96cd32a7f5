"""LASNet with random weights, and without the data sets that its package imports."""

from rgbt.models.external.adapting import Untrained, replace_in, skip_init


def network(n_classes):
    """Build the network."""
    skip_init("toolbox")
    import resnet
    from toolbox.models.LASNet import LASNet

    replace_in(LASNet, Backbone_ResNet152_in3=Untrained(resnet).Backbone_ResNet152_in3)
    return LASNet(n_classes)
