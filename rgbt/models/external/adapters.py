"""Builders of networks whose repositories need more than a call, one for each recipe that names it.

`model.constructor` names one: "adapters.py:gmnet". The file is read by its path and its digest is
part of the run key, as that of a user's own adapter; its functions import modules of a checkout.
They give random weights instead of ImageNet's, and leave out data sets and packages that a
repository imports without using them for its network.
"""

from importlib import import_module

import torch

from rgbt.models.external.adapting import (
    Untrained,
    allow_cpu,
    replace_in,
    replaced,
    skip_init,
    stand_in,
)


def _with_torchvision(made, *arguments):
    """A network whose module builds its encoders from torchvision.models."""
    replace_in(made, models=Untrained(import_module("torchvision.models")))
    return made(*arguments)


def _with_resnet152(made, *arguments):
    """A network whose module takes Backbone_ResNet152_in3 from resnet.py of its checkout."""
    import resnet

    replace_in(made, Backbone_ResNet152_in3=Untrained(resnet).Backbone_ResNet152_in3)
    return made(*arguments)


def _with_convnext(num_classes):
    from Convnextv2 import convnextv2
    from Convnextv2.builder import Convnextv2

    replace_in(Convnextv2, ConvNeXtV2=Untrained(convnextv2).ConvNeXtV2)
    return Convnextv2(num_classes=num_classes)


def cainet(n_classes):
    """CAINet."""
    skip_init("toolbox")
    from toolbox.models.backbone import mobilenetv2
    from toolbox.models.cainet import mobilenetGloRe3_CRRM_dule_arm_bou_att as network

    replace_in(network, mobilenet_v2=Untrained(mobilenetv2).mobilenet_v2)
    return network(n_classes)


def cenet(n_class, trianing_style):
    """CENet; the argument is spelt so in the code."""
    from TSmodel.Teacher_model import Teacher_model

    return _with_torchvision(Teacher_model, n_class, trianing_style)


def cigfnet(num_classes):
    """CIGF-Net; basicsr, of which it uses two functions of timm, may be missing."""
    layers = import_module("timm.layers")
    two = {name: getattr(layers, name) for name in ("to_2tuple", "trunc_normal_")}
    stand_in("basicsr.utils.registry")
    stand_in("basicsr.archs.arch_util", **two)
    return _with_convnext(num_classes)


def dformer_l(cfg):
    """DFormer, whose decoder moves its random bases to the GPU."""
    allow_cpu()
    from models.builder import EncoderDecoder

    return EncoderDecoder(cfg)


def eaefnet(n_class):
    """EAEFNet for MFNet."""
    allow_cpu()
    from model.EAEFNet import EAEFNet

    return _with_torchvision(EAEFNet, n_class)


def eaefnet_pst(n_class):
    """EAEFNet for PST900."""
    allow_cpu()
    from model.EAEFNet.EAEFNet import EAEFNet

    return _with_torchvision(EAEFNet, n_class)


def ecm(n_classes):
    """ECM."""
    skip_init("toolbox")
    from toolbox.models.ECM import ECM

    return _with_resnet152(ECM, n_classes)


def egfnet(n_classes):
    """EGFNet."""
    skip_init("toolbox")
    from toolbox.models.EGFNet import EGFNet

    return _with_resnet152(EGFNet, n_classes)


def feanet(n_class):
    """FEANet."""
    from model.FEANet import FEANet

    return _with_torchvision(FEANet, n_class)


def geminifusion_b3(**arguments):
    """GeminiFusion; parts of mmcv and mmdet that it does not use may be missing."""
    for name in ("mmcv_custom", "mmdet.utils"):
        stand_in(name)
    from models.segformer import WeTr

    head = {"head.weight": None, "head.bias": None}  # removed from every file
    replace_in(WeTr, torch=replaced(torch, load=lambda _: dict(head)))
    return WeTr(**arguments)


def gmnet(n_classes):
    """GMNet."""
    skip_init("toolbox")
    from toolbox.models.GMNet import GMNet

    return _with_torchvision(GMNet, n_classes)


def lasnet(n_classes):
    """LASNet."""
    skip_init("toolbox")
    from toolbox.models.LASNet import LASNet

    return _with_resnet152(LASNet, n_classes)


def mdrnet(n_class):
    """MDRNet+."""
    from model.model import TFNet

    return _with_torchvision(TFNet, n_class)


def mmsformer_b4(**arguments):
    """MMSFormer."""
    skip_init("semseg")
    from semseg.models.backbones import mmsformer
    from semseg.models.mmsformer import MMSFormer

    mmsformer.torch = replaced(torch, load=lambda *_, **__: {})
    return MMSFormer(**arguments)


def msirtnet(num_classes):
    """MS-IRTNet."""
    return _with_convnext(num_classes)


def pstnet(num_channels, num_classes):
    """PSTNet, with random weights of its RGB half."""
    allow_cpu()
    from architectures.pstnet_thermal.pstnet_thermal import Net

    replace_in(Net, torch=replaced(torch, load=lambda _: {}))
    return Net(num_channels, num_classes)


def rtfnet(n_class):
    """RTFNet."""
    from model.RTFNet import RTFNet

    return _with_torchvision(RTFNet, n_class)


def sfafma(n_class):
    """SFAF-MA; packages that it imports and does not use may be missing."""
    for name in ("seaborn", "audtorch.metrics.functional", "thop"):
        stand_in(name)
    from model.SFAFMA import SFAFMA

    return _with_torchvision(SFAFMA, n_class)


def sgfnet(n_classes):
    """SGFNet."""
    allow_cpu()
    from SGFNet import SGFNet

    return _with_torchvision(SGFNet, n_classes)


def stitchfusion_b4(**arguments):
    """StitchFusion."""
    skip_init("semseg")
    from semseg.models.stitchfusion import stitchfusion

    return stitchfusion(**arguments)
