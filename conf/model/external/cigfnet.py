"""CIGF-Net with random weights; basicsr, of which it uses two functions of timm, may be missing."""

import timm.layers

from rgbt.models.external.adapting import Untrained, replace_in, stand_in


def network(num_classes):
    """Build the network."""
    two = {name: getattr(timm.layers, name) for name in ("to_2tuple", "trunc_normal_")}
    stand_in("basicsr.utils.registry")
    stand_in("basicsr.archs.arch_util", **two)
    from Convnextv2 import convnextv2
    from Convnextv2.builder import Convnextv2

    replace_in(Convnextv2, ConvNeXtV2=Untrained(convnextv2).ConvNeXtV2)
    return Convnextv2(num_classes=num_classes)
