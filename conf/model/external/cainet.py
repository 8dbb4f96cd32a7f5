"""CAINet with random weights, and without the data sets that its package imports."""

from rgbt.models.external.adapting import Untrained, replace_in, skip_init


def network(n_classes):
    """Build the network."""
    skip_init("toolbox")
    from toolbox.models.backbone import mobilenetv2
    from toolbox.models.cainet import mobilenetGloRe3_CRRM_dule_arm_bou_att as cainet

    replace_in(cainet, mobilenet_v2=Untrained(mobilenetv2).mobilenet_v2)
    return cainet(n_classes)
