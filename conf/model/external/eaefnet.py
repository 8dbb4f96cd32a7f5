"""EAEFNet with random weights instead of ImageNet's."""

import torchvision

from rgbt.models.external.adapting import Untrained, allow_cpu, replace_in


def network(n_class):
    """Build the network."""
    allow_cpu()
    from model.EAEFNet import EAEFNet

    replace_in(EAEFNet, models=Untrained(torchvision.models))
    return EAEFNet(n_class)
