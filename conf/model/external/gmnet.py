"""GMNet with random weights, and without the data sets that its package imports."""

import torchvision

from rgbt.models.external.adapting import Untrained, replace_in, skip_init


def network(n_classes):
    """Build the network."""
    skip_init("toolbox")
    from toolbox.models.GMNet import GMNet

    replace_in(GMNet, models=Untrained(torchvision.models))
    return GMNet(n_classes)
