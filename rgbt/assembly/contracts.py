"""Check a user's own components against the interfaces of rgbt.

Classes outside this package need the members of `MEMBERS` before training starts; what they return
is checked where a wrong value would be trained on or counted without an error. InputError names the
member or the returned value, and what was expected.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from torch import Tensor, nn

from rgbt.checks import InputError, check_members, described
from rgbt.requirements import LossRecord, NetworkRecord, name_of, record_of
from rgbt.types import IGNORE, Output, Sample

DATASET = ("root", "name", "num_classes", "classes", "palette", "unscored", "background", "splits")
Calls = dict[str, tuple[str, ...]]

# Attributes of a component, its methods and their arguments (`rgbt.checks.check_members`).
MEMBERS: dict[str, tuple[tuple[str, ...], Calls]] = {
    "dataset": (
        DATASET,
        {
            "has": ("split",),
            "names": ("split",),
            "read": ("name",),
            "label": ("name",),
            "files": ("name",),
            "nights": ("names",),
            "fingerprint": (),
            "decoding": (),
        },
    ),
    "model": ((), {"forward": ("rgb", "thermal", "masks", "views=", "generator=")}),
    "loss": ((), {"__call__": ("output", "batch", "generator")}),
    "loss of two frames": ((), {"__call__": ("first", "second", "warped", "valid", "generator")}),
    "scheme": ((), {"phases": ("batch", "generator_of")}),
    "transform": ((), {"train": ("sample", "rng"), "test": ("sample",)}),
    "metric": (("name", "partition", "regions", "absent"), {"map": ("image_hw",)}),
}

# Further arguments of a network that returns masks and whose record says stacks_passes=True.
STACKED = ("passes=", "num_predictions=", "num_masks=")

# Arrays of a sample: shape and dtype; equal letters are equal sizes. A label may be None.
SAMPLE = {"rgb": ("H W 3", "uint8"), "thermal": ("H W", "uint8"), "label": ("H W", "uint8")}


def is_own(part: object) -> bool:
    """Say whether a component is the user's own, that is, not a class of this package."""
    return type(part).__module__.partition(".")[0] != "rgbt"


def check_part(node: str, part: object, kind: str = "") -> None:
    """Refuse a user's component, at `node` of the configuration, without members of its `kind`."""
    if is_own(part):
        check_members(node, part, *MEMBERS[kind or node])


def check_arrays(
    returned: str, value: Any, arrays: Mapping[str, tuple[str, str]], **sizes: int
) -> None:
    """Refuse a value of which an array, an attribute or key, has another shape or dtype.

    `returned` begins the message; `arrays` has shape and dtype ("": any) of each, see `SAMPLE`;
    `sizes` are the dimensions that are known.
    """
    for name, (shape, dtype) in arrays.items():
        found = value[name] if isinstance(value, Mapping) else getattr(value, name, None)
        if found is None and name == "label":
            continue
        letters, size = shape.split(), tuple(getattr(found, "shape", (None,)))
        wanted = [int(text) if text.isdigit() else sizes.get(text, text) for text in letters]
        fits = all(isinstance(a, str) or a == b for a, b in zip(wanted, size, strict=False))
        is_dtype = dtype in ("", str(getattr(found, "dtype", "")))
        if None in size or len(size) != len(letters) or not fits or not is_dtype:
            expected = f"({', '.join(map(str, wanted))}) {dtype}".rstrip()
            raise InputError(f"{returned} {name} {described(found)}; expected {expected}.")
        sizes |= dict(zip(letters, size, strict=True))


def check_type(returned: str, value: object, kind: type) -> None:
    """Refuse a returned value that is not a `kind`."""
    if not isinstance(value, kind):
        raise InputError(f"{returned} {described(value)}; expected {kind.__name__}.")


def check_dataset(dataset: Any, splits: Iterable[str] = ()) -> None:
    """Refuse a user's data set that differs from `rgbt.dataset.LabelledDataset`.

    The first sample of each of the `splits` is read.
    """
    if not is_own(dataset):
        return
    check_part("dataset", dataset)
    kind = f"dataset: {type(dataset).__name__}"
    sizes = [dataset.num_classes, len(dataset.classes), len(dataset.palette)]
    if len(set(sizes)) > 1:
        raise InputError(
            f"{kind} has num_classes={sizes[0]}, {sizes[1]} classes and {sizes[2]} colours in "
            "palette; expected one of each per class."
        )
    for name in (dataset.names(split)[0] for split in splits):
        returned = f"{kind}.read('{name}') returned"
        sample = dataset.read(name)
        check_sample(returned, sample, name)
        labels = np.empty(0) if sample.label is None else sample.label
        wrong = labels[(labels >= dataset.num_classes) & (labels != IGNORE)]
        if wrong.size:
            raise InputError(
                f"{returned} the label value {wrong[0]} ({wrong.size} pixels); expected 0 to "
                f"{dataset.num_classes - 1}, or {IGNORE} to ignore a pixel."
            )


def check_sample(returned: str, sample: Any, name: str) -> None:
    """Refuse anything but a `rgbt.types.Sample` of that name; `returned` begins the message."""
    check_type(returned, sample, Sample)
    if sample.name != name:
        raise InputError(f"{returned} the name '{sample.name}'; expected '{name}'.")
    check_arrays(returned, sample, SAMPLE)


def check_regions(regions: Any, image_hw: tuple[int, int]) -> None:
    """Refuse a user's partition that does not behave like `rgbt.metrics.metric.Regions`."""
    if not is_own(regions):
        return
    check_part("metric", regions)
    returned = f"metric: {type(regions).__name__}.map({image_hw}) returned"
    found = regions.map(image_hw)
    height, width = image_hw
    check_arrays(returned, {"": found}, {"": ("H W", "uint8")}, H=height, W=width)
    if found.max() >= regions.regions:
        raise InputError(f"{returned} {found.max()}; expected regions 0 to {regions.regions - 1}.")


def watch_model(model: nn.Module, num_classes: int) -> None:
    """Check the output of a user's network in its first training and evaluation pass.

    The arguments of its `forward` are checked at once.
    """
    if not is_own(model):
        return
    record = record_of(model, NetworkRecord)
    _, calls = MEMBERS["model"]
    stacked = STACKED if record.stacks_passes and record.outputs == "masks" else ()
    check_members("model", model, (), {"forward": (*calls["forward"], *stacked)})
    left = {True, False}

    def check(
        module: nn.Module, args: tuple[Any, ...], keywords: dict[str, Any], found: Any
    ) -> None:
        left.discard(module.training)
        if not left:
            handle.remove()
        count, _, height, width = (args[0] if args else keywords["rgb"]).shape
        returned = f"model: {type(module).__name__}.forward returned"
        check_type(returned, found, Output)
        declared = {"aux_logits": record.auxiliary, "features": record.features}
        for name, is_declared in declared.items():
            if is_declared and name not in found.aux:
                raise InputError(f"{returned} aux without `{name}`, which its record declares.")
        if found.logits is None and module.training and record.outputs == "masks":
            return  # its loss reads `aux`
        arrays = {"logits": ("B K H W", "")}
        check_arrays(returned, found, arrays, B=count, K=num_classes, H=height, W=width)

    handle = model.register_forward_hook(check, with_kwargs=True)


class CheckedLoss:
    """A user's loss, of whose first call the returned value is checked against `rgbt.types.Loss`.

    It has the attributes of the loss.
    """

    def __init__(self, loss: Any) -> None:
        self._loss, self._is_checked = loss, False
        self._shape = "P" if record_of(loss, LossRecord).frames == 1 else ""
        check_part("loss", loss, "loss" if self._shape else "loss of two frames")

    def __getattr__(self, key: str) -> Any:
        if key.startswith("_"):
            raise AttributeError(key)
        return getattr(self._loss, key)

    def __call__(self, *arguments: Any) -> Any:
        """Call the loss; check what the first call returns."""
        found = self._loss(*arguments)
        if not self._is_checked:
            returned = f"loss: {name_of(self._loss)} returned"
            check_type(returned, found, dict)
            check_arrays(returned, found, dict.fromkeys(found, (self._shape, "")))
            if not any(isinstance(part, Tensor) and part.requires_grad for part in found.values()):
                what = f"{returned} {described(found)}"
                raise InputError(f"{what}, none of which depends on the network.")
            self._is_checked = True
        return found
