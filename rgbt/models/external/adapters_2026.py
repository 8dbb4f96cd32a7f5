"""Builders of networks of 2025 and 2026, as in `adapters.py`.

The digest of an adapter's file is part of the run key. With a file of their own, they leave the
keys of finished runs of the older networks as they are.
"""

import sys

import torch
from torch.nn import functional as F

from rgbt.models.external.adapting import replace_in, skip_init, stand_in


def cmssm(**arguments):
    """CM-SSM; mamba_ssm may be missing, as may modules that only other ways of fusion use."""
    skip_init("backbone.efficientvit.apps.trainer")
    stand_in("backbone.efficientvit.apps.utils")
    for name in ("CMX.models.net_utils", "MAINet", "MDNet.model", "sigma.encoders.vmamba"):
        stand_in(f"model_others.RGB_T.{name}")
    stand_in("proposed.attention_module")
    from backbone.efficientvit.models.efficientvit.backbone import EfficientViTBackbone
    from models.CM_SSM import Fusion_Module, Model

    EfficientViTBackbone.init_weights = lambda *_, **__: None  # reads files of its author
    if not hasattr(sys.modules[Fusion_Module.__module__], "selective_scan_fn"):
        replace_in(Fusion_Module, selective_scan_fn=selective_scan)
    return Model(**arguments)


def tuni(**arguments):
    """TUNI; its author's folder was called proposed, and modules of its ablations are missing."""
    import backbone_model.TUNI
    import decoder.Hamburger
    import decoder.MLP

    for module in (backbone_model.TUNI, decoder.Hamburger, decoder.MLP):
        sys.modules[f"proposed.{module.__name__}"] = module
    for name in ("wo_localrgbt", "wo_globalrgbt", "wo_localrgbrgb"):
        stand_in(f"proposed.backbone_model.ablation_{name}")
    from model1 import Model

    return Model(**arguments)


def selective_scan(u, delta, a, b, c, d, *, delta_bias, **_):  # noqa: PLR0913 - as it is called
    """Compute the selective scan of Mamba, which mamba_ssm has for GPUs only: (N, G D, L) as `u`.

        h_t = exp(s_t A) h_(t-1) + s_t B_t u_t,  y_t = C_t h_t + D u_t,  s = softplus(delta + bias)

    u and delta (N, G D, L), a (G D, S), b and c (N, G, S, L) for G groups of channels, d and
    delta_bias (G D). Source: Gu and Dao, Mamba, arXiv 2312.00752, Algorithm 2.
    """
    channels = u.shape[1] // b.shape[1]
    step = F.softplus(delta + delta_bias[:, None])
    decay = torch.exp(step[:, :, None] * a[:, :, None])
    entered = (step * u)[:, :, None] * b.repeat_interleave(channels, 1)
    shown = c.repeat_interleave(channels, 1)
    state, scanned = torch.zeros_like(decay[..., 0]), []
    for parts in zip(decay.unbind(-1), entered.unbind(-1), shown.unbind(-1), strict=True):
        state = parts[0] * state + parts[1]
        scanned.append((state * parts[2]).sum(-1))
    return torch.stack(scanned, -1) + d[:, None] * u
