"""MS-IRTNet with random weights instead of ImageNet's."""

from rgbt.models.external.adapting import Untrained, replace_in


def network(num_classes):
    """Build the network."""
    from Convnextv2 import convnextv2
    from Convnextv2.builder import Convnextv2

    replace_in(Convnextv2, ConvNeXtV2=Untrained(convnextv2).ConvNeXtV2)
    return Convnextv2(num_classes=num_classes)
