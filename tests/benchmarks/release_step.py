"""One training step of the CRM release, from its checkout, to be timed beside ours.

Its network, criterion, matcher and optimiser run unchanged. What they import of detectron2, timm,
fvcore, mmcv and Lightning is replaced by the few functions below, so that none has to be installed.
Without its compiled operator, the release takes its own branch in PyTorch; where that operator is
installed (``MultiScaleDeformableAttention``), it takes that one.

Checkout: github.com/UkcheolShin/CRM_RGBTSeg, tried at a791023.
"""

from __future__ import annotations

import importlib
import importlib.util
import io
import math
import sys
from collections import namedtuple
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import torch
import yaml
from torch import Tensor, nn
from torch.nn import functional as F

POINT_FEATURES = "detectron2.projects.point_rend.point_features"
OPERATOR = "MultiScaleDeformableAttention"
# Its settings under which our sizes of a network stand, keys of conf/model/mask2former.yaml.
PLACES = {
    "embed_dim": "MODEL.SWIN.EMBED_DIM",
    "depths": "MODEL.SWIN.DEPTHS",
    "num_heads": "MODEL.SWIN.NUM_HEADS",
    "window_size": "MODEL.SWIN.WINDOW_SIZE",
    "drop_path_rate": "MODEL.SWIN.DROP_PATH_RATE",
    "hidden_dim": "MODEL.SEM_SEG_HEAD.CONVS_DIM MODEL.SEM_SEG_HEAD.MASK_DIM "
    "MODEL.MASK_FORMER.HIDDEN_DIM",
    "num_queries": "MODEL.MASK_FORMER.NUM_OBJECT_QUERIES",
    "encoder_layers": "MODEL.SEM_SEG_HEAD.TRANSFORMER_ENC_LAYERS",
    "decoder_layers": "MODEL.MASK_FORMER.DEC_LAYERS",
    "decoder_ffn_dim": "MODEL.MASK_FORMER.DIM_FEEDFORWARD",
    "attention_heads": "MODEL.MASK_FORMER.NHEADS",
}

ShapeSpec = namedtuple("ShapeSpec", "channels height width stride", defaults=(None,) * 4)


class Node(dict[str, Any]):
    """Settings as detectron2 has them: ``cfg.MODEL.SWIN``; a missing one is a new node."""

    def __getattr__(self, name: str) -> Any:
        """The setting of this name."""
        return self.setdefault(name, Node())

    __setattr__ = dict.__setitem__

    def update_from(self, values: dict[str, Any]) -> None:
        """Merge nested values."""
        for name, value in values.items():
            if isinstance(value, dict):
                getattr(self, name).update_from(value)
            else:
                self[name] = value


class Registry(dict[str, Any]):
    """Classes by name."""

    def __init__(self, *_: object, **__: object) -> None:
        super().__init__()

    def register(self) -> Callable[[Any], Any]:
        """A decorator that notes a class."""
        return lambda kind: self.setdefault(kind.__name__, kind)

    def register_module(self, **_: object) -> Callable[[Any], Any]:
        """The same, as mmcv calls it."""
        return self.register()

    def get(self, name: str) -> Any:  # type: ignore[override]
        """The class of this name."""
        return self[name]


class Conv2d(nn.Conv2d):
    """A convolution followed by a normalisation and an activation."""

    def __init__(
        self, *sizes: int, norm: Any = None, activation: Any = None, **others: Any
    ) -> None:
        super().__init__(*sizes, **others)
        self.norm, self.activation = norm, activation

    def forward(self, x: Tensor) -> Tensor:
        """(B, c, H, W) -> (B, C, H, W)."""
        x = super().forward(x)
        x = x if self.norm is None else self.norm(x)
        return x if self.activation is None else self.activation(x)


class Backbone(nn.Module):
    """Says what maps it makes."""

    def output_shape(self: Any) -> dict[str, ShapeSpec]:
        """Channels and stride by name of a map."""
        strides = self._out_feature_strides
        widths = self._out_feature_channels
        return {name: ShapeSpec(widths[name], stride=strides[name]) for name in self._out_features}


class DropPath(nn.Module):
    """Stochastic depth by sample."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate

    def forward(self, x: Tensor) -> Tensor:
        """Zero some samples in training, and scale the others."""
        if self.rate == 0 or not self.training:
            return x
        keep = x.new_empty((len(x), *[1] * (x.ndim - 1))).bernoulli_(1 - self.rate)
        return x * keep / (1 - self.rate)


def configurable(initialise: Callable[..., None]) -> Callable[..., None]:
    """Let a class be made of settings, by its `from_config`."""

    def made(self: Any, *arguments: Any, **keywords: Any) -> None:
        if arguments and isinstance(arguments[0], Node):
            keywords, arguments = type(self).from_config(*arguments, **keywords), ()
        initialise(self, *arguments, **keywords)

    return made


def point_sample(maps: Tensor, points: Tensor, **keywords: Any) -> Tensor:
    """Values (N, C, P) of maps (N, C, H, W) at points (N, P, 2) in [0, 1]."""
    return F.grid_sample(maps, 2 * points[:, :, None] - 1, **keywords)[..., 0]


def uncertain_points(
    logits: Tensor, uncertainty: Any, count: int, oversample: float, important: float
) -> Tensor:
    """The least certain of random points, and further random ones: (N, count, 2)."""
    drawn = torch.rand(len(logits), int(count * oversample), 2, device=logits.device)
    found = uncertainty(point_sample(logits, drawn, align_corners=False))[:, 0]
    kept = int(important * count)
    index = found.topk(kept, dim=1).indices[..., None].expand(-1, -1, 2)
    fresh = torch.rand(len(logits), count - kept, 2, device=logits.device)
    return torch.cat([drawn.gather(1, index), fresh], dim=1)


def xavier(layer: nn.Module) -> None:
    """The initial weights of a convolution (Caffe2's)."""
    nn.init.kaiming_uniform_(layer.weight, a=1)  # type: ignore[arg-type]
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)  # type: ignore[arg-type]


def _stand_ins() -> dict[str, Any]:
    """What the release imports, by dotted name."""
    backbones, heads, meta = Registry(), Registry(), Registry()

    def build_backbone(cfg: Node) -> Any:
        return backbones[cfg.MODEL.BACKBONE.NAME](cfg, ShapeSpec(4))

    def build_head(cfg: Node, shape: Any) -> Any:
        return heads[cfg.MODEL.SEM_SEG_HEAD.NAME](cfg, shape)

    def images(tensors: list[Tensor], _: int) -> Any:
        return SimpleNamespace(tensor=torch.stack(tensors))

    return {
        "detectron2.config.configurable": configurable,
        "detectron2.config.CfgNode": Node,
        "detectron2.layers.Conv2d": Conv2d,
        "detectron2.layers.ShapeSpec": ShapeSpec,
        "detectron2.layers.get_norm": lambda name, width: nn.GroupNorm(32, width),
        "detectron2.modeling.ShapeSpec": ShapeSpec,
        "detectron2.modeling.Backbone": Backbone,
        "detectron2.modeling.backbone.Backbone": Backbone,
        "detectron2.modeling.BACKBONE_REGISTRY": backbones,
        "detectron2.modeling.SEM_SEG_HEADS_REGISTRY": heads,
        "detectron2.modeling.META_ARCH_REGISTRY": meta,
        "detectron2.modeling.build_backbone": build_backbone,
        "detectron2.modeling.build_sem_seg_head": build_head,
        "detectron2.structures.ImageList": SimpleNamespace(from_tensors=images),
        "detectron2.utils.registry.Registry": Registry,
        "detectron2.utils.comm.get_world_size": lambda: 1,
        f"{POINT_FEATURES}.point_sample": point_sample,
        f"{POINT_FEATURES}.get_uncertain_point_coords_with_randomness": uncertain_points,
        "fvcore.nn.weight_init.c2_xavier_fill": xavier,
        "timm.models.layers.DropPath": DropPath,
        "timm.models.layers.to_2tuple": lambda x: x if isinstance(x, tuple) else (x, x),
        "timm.models.layers.trunc_normal_": nn.init.trunc_normal_,
        "mmcv.utils.Registry": Registry,
        "pytorch_lightning.LightningModule": nn.Module,
        "torchvision.utils": None,
        "torchvision._is_tracing": lambda: False,
    }


class _Absent(ModuleType):
    """A module that is not installed; what nothing stands for is a mock."""

    __path__: list[str] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return mock.MagicMock(name=f"{self.__name__}.{name}")


def _install(checkout: Path) -> None:
    """Let ``import models`` find the release, and its imports the stand-ins."""
    for path, value in _stand_ins().items():
        module, _, name = path.rpartition(".")
        parents = module.split(".")
        for depth in range(1, len(parents) + 1):
            dotted = ".".join(parents[:depth])
            sys.modules.setdefault(dotted, _Absent(dotted))
            if depth > 1:
                setattr(
                    sys.modules[".".join(parents[: depth - 1])],
                    parents[depth - 1],
                    sys.modules[dotted],
                )
        if value is not None:
            setattr(sys.modules[module], name, value)
    for absent in (
        *("detectron2.data", "detectron2.modeling.postprocessing", "detectron2.utils.memory"),
        *("detectron2.solver.build", "detectron2.projects.deeplab", "sklearn.metrics", "imageio"),
        *("mmcv", "torchvision.utils", "util.util"),
    ):
        sys.modules.setdefault(absent, _Absent(absent))
    if importlib.util.find_spec(OPERATOR) is None:  # without functions: it takes its own branch
        sys.modules[OPERATOR] = ModuleType(OPERATOR)
    sys.path.insert(0, str(checkout))


class _Settings(yaml.SafeLoader):
    """Reads plain values; the release lets YAML evaluate an expression, which no step needs."""


_Settings.add_multi_constructor("tag:yaml.org,2002:python/", lambda *_: None)


def settings(checkout: Path, network: dict[str, Any], num_points: int) -> Node:
    """Its configuration for MFNet, with our sizes of the network."""
    cfg = Node()
    importlib.import_module("models.mask2former.config").add_maskformer2_config(cfg)
    importlib.import_module("models.config").add_CRM_config(cfg)
    base = checkout / "configs/MFdataset/Base-MFdataset-SemanticSegmentation.yaml"
    cfg.update_from(yaml.load(base.read_text(), _Settings))
    cfg.SOLVER.WEIGHT_DECAY_NORM = 0.0
    cfg.MODEL.MASK_FORMER.TRAIN_NUM_POINTS = num_points
    for name, places in PLACES.items():
        for place in places.split():
            *path, last = place.split(".")
            node = cfg
            for key in path:
                node = getattr(node, key)
            node[last] = network[name]
    cfg.MODEL.MASK_FORMER.DEC_LAYERS += 1  # it counts the initial prediction
    return cfg


def release_step(
    checkout: Path,
    network: dict[str, Any],
    *,
    num_points: int,
    images: Tensor,
    label: Tensor,
    hidden: Tensor,
) -> Callable[[], float]:
    """Return a function that makes one training step and returns its loss.

    Args:
        checkout: of the release.
        network: our sizes, keys of ``conf/model/mask2former.yaml``.
        num_points: at which masks are compared.
        images: (B, 4, H, W) float32, 0 to 255, sides multiples of 32.
        label: (B, H, W) int64 on the CPU.
        hidden: (B, 2, 1, H / 4, W / 4) float32, 1 = hidden token of RGB and thermal.
    """
    _install(checkout)
    cfg = settings(checkout, network, num_points)
    device = images.device
    wrapper = importlib.import_module("models.Model_RGBT_Mask2Former")
    decoder = sys.modules["models.mask2former"].MSDeformAttnPixelDecoder
    published = decoder.from_config

    def with_our_width(*arguments: Any) -> dict[str, Any]:  # its code fixes 1024
        return published(*arguments) | {"transformer_dim_feedforward": network["encoder_ffn_dim"]}

    decoder.from_config = with_our_width
    model = wrapper.RGBTMaskFormer(cfg).to(device).train()
    with redirect_stdout(io.StringIO()):  # it prints names of parameters
        optimizer = wrapper.Model_RGBT_Mask2Former.build_optimizer(cfg, model)
    inputs = []
    for image, target, mask in zip(images, label, hidden, strict=True):
        classes = target.unique()
        instances = SimpleNamespace(
            gt_classes=classes.to(device),
            gt_masks=torch.stack([target == value for value in classes]).to(device),
        )
        instances.to = lambda _, found=instances: found
        inputs.append({"image": image, "instances": instances, "mask": mask.to(device)})

    def step() -> float:
        *supervised, sdc, sdn = model(inputs)
        loss = sum(sum(losses.values()) for losses in supervised) + sdc + sdn
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        value = float(loss.item())
        if not math.isfinite(value):
            raise RuntimeError(f"the loss of the release is {value}.")
        return value

    return step
