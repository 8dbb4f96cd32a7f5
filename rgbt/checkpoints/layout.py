"""Types that describe a kind of file: how it is recognised, and where each of its names belongs."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from rgbt.checkpoints.read import Contents

Shapes = Mapping[str, tuple[int, ...]]
Overrides = tuple[str, ...]
Reasons = tuple[tuple[str, str], ...]
"""(regular expression for the beginning of a name, reason); the first match counts."""

NOT_IN_FILE = "not part of the ImageNet network"
DERIVED = "rebuilt from the sizes of the network"
COUNTER = "num_batches_tracked"
"""Last word of batch normalisation's counters, which files of old torch versions lack."""


@dataclass(frozen=True)
class Facts:
    """Description of a file, derived from its names and shapes.

    Attributes:
        layout: name of the layout.
        what: in words, such as "CMX checkpoint".
        family: of networks that the file holds a whole one of; "" where it is a backbone.
        size: in words, such as "MiT-B2"; "" where it has none of the published sizes.
        classes: K; None for a backbone, or where it cannot be read.
        prefix: before every name that belongs to the network.
        window: side of the attention windows in tokens, where there are such.
        fits: command-line overrides of the networks that the file fits; the first is the usual.
        convention: overrides for the release's inputs and evaluation, which its weights do not
            show.
        inputs: inputs of the network as noted in the file; None without a note.
        remarks: remarks for the user of the file.
    """

    layout: str
    what: str
    family: str = ""
    size: str = ""
    classes: int | None = None
    prefix: str = ""
    window: int | None = None
    fits: tuple[Overrides, ...] = ()
    convention: Overrides = ()
    inputs: Mapping[str, object] | None = None
    remarks: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Layout, size and classes in words."""
        classes = "" if self.classes is None else f"{self.classes} classes"
        details = ", ".join(filter(None, (self.size, classes)))
        return f"{self.what} ({details})" if details else self.what


@dataclass(frozen=True)
class Rule:
    """How a network is filled from a file.

    Attributes:
        source: entry of the network -> name in the file, without `Facts.prefix`.
        fresh: entries that such a file does not hold, which keep their initial values.
        leftover: names of the file that the network has no place for.
        stems: entries whose input channels may be others than in the file: for one channel the
            mean over the file's, for further ones behind the file's the same mean.
        positions: entries whose first position the file may lack; it is 0 then.
        remarks: as in `Facts`.
    """

    source: Callable[[str], str] = str
    fresh: Reasons = ()
    leftover: Reasons = ()
    stems: Collection[str] = ()
    positions: Collection[str] = ()
    remarks: tuple[str, ...] = ()


RuleOf = Callable[[str, nn.Module, Facts], Rule | None]
"""(family, network, facts) -> how such a network is filled, None where the file is of no use."""


@dataclass(frozen=True)
class Layout:
    """A kind of file; files of whole networks fit their own family only.

    Attributes:
        recognise: what a file is, None where it is of another layout.
        rule: see `RuleOf`.
        converted: tensors of the file -> under the names that the rule has as sources; for files
            that split tensors of the network.
    """

    recognise: Callable[[Contents], Facts | None]
    rule: RuleOf
    converted: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]] = dict


def reason(reasons: Reasons, name: str) -> str | None:
    """The first reason whose pattern fits the beginning of `name`."""
    return next((why for pattern, why in reasons if re.match(pattern, name)), None)


def shapes_of(tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Name -> shape."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def has_parts(names: Collection[str], *parts: str) -> bool:
    """Whether there are names that begin with each of the parts."""
    return all(any(name.startswith(part) for name in names) for part in parts)


def size_at(shapes: Shapes, name: str, dimension: int = 0) -> int | None:
    """One size of a tensor, None where it is missing or has fewer dimensions."""
    shape = shapes.get(name, ())
    return shape[dimension] if dimension < len(shape) else None


def count_blocks(names: Collection[str], pattern: str) -> int:
    """How many different numbers the first group of `pattern` takes among the names."""
    matches = (re.match(pattern, name) for name in names)
    return len({match.group(1) for match in matches if match})


FAMILIES: Mapping[str, str] = {
    "mask2former": "RGB-T Mask2Former",
    "dinov2": "DINOv2 or DINOv3 with Mask2Former's head",
    "cmx": "CMX",
    "cmnext": "CMNeXt",
    "rtfnet": "RTFNet",
    "mfnet": "MFNet",
    "pspnet": "PSPNet (HeatNet)",
    "semseg": "PSPNet (semseg)",
    "deeplabv2": "DeepLab v2",
    "external": "a network of another author",
}
"""Module of rgbt.models -> what its network is called."""

CLASS_PARTS: Mapping[str, tuple[str, ...]] = {
    "mask2former": ("sem_seg_head.predictor.class_embed",),
    "dinov2": ("sem_seg_head.predictor.class_embed",),
    "cmx": ("decode_head.linear_pred",),
    "cmnext": ("decode_head.linear_pred",),
    "rtfnet": ("deconv5.1",),
    "mfnet": ("decode1",),
    "pspnet": ("final",),
    "semseg": ("cls.4", "aux.4"),
    "deeplabv2": ("heads", "auxiliary"),
}
"""Parts of a network whose sizes depend on the number of classes."""


def family_of(network: type[nn.Module]) -> str:
    """The module of rgbt.models that a class or a base of it is from, "" for all others."""
    return next(filter(None, (family_named(each.__module__) for each in network.__mro__)), "")


def family_named(path: str) -> str:
    """The same for a dotted path: "cmx" for "rgbt.models.cmx.model.CMX"."""
    words = path.split(".")
    return words[2] if words[:2] == ["rgbt", "models"] and len(words) > 2 else ""
