"""FEANet with random weights instead of ImageNet's."""

import torchvision

from rgbt.models.external.adapting import Untrained, replace_in


def network(n_class):
    """Build the network."""
    from model.FEANet import FEANet

    replace_in(FEANet, models=Untrained(torchvision.models))
    return FEANet(n_class)
