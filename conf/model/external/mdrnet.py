"""MDRNet+ with random weights instead of ImageNet's."""

import torchvision

from rgbt.models.external.adapting import Untrained, replace_in


def network(n_class):
    """Build the network."""
    from model.model import TFNet

    replace_in(TFNet, models=Untrained(torchvision.models))
    return TFNet(n_class)
