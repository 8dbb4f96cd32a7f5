"""RTFNet with random weights instead of ImageNet's."""

import torchvision

from rgbt.models.external.adapting import Untrained, replace_in


def network(n_class):
    """Build the network."""
    from model.RTFNet import RTFNet

    replace_in(RTFNet, models=Untrained(torchvision.models))
    return RTFNet(n_class)
