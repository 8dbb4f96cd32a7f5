"""SGFNet with random weights instead of ImageNet's."""

import torchvision

from rgbt.models.external.adapting import Untrained, allow_cpu, replace_in


def network(n_classes):
    """Build the network."""
    allow_cpu()
    from SGFNet import SGFNet

    replace_in(SGFNet, models=Untrained(torchvision.models))
    return SGFNet(n_classes)
