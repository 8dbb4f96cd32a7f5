"""SFAF-MA with random weights; packages that it imports and does not use may be missing."""

import torchvision

from rgbt.models.external.adapting import Untrained, replace_in, stand_in


def network(n_class):
    """Build the network."""
    for name in ("seaborn", "audtorch.metrics.functional", "thop"):
        stand_in(name)
    from model.SFAFMA import SFAFMA

    replace_in(SFAFMA, models=Untrained(torchvision.models))
    return SFAFMA(n_class)
