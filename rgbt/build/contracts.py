"""Check a user's own components against the interfaces that rgbt expects.

Classes of this package are not checked, because the test suite covers them. Other classes are
compared with `rgbt.types` and `rgbt.dataset` before training starts. What they return is checked
the first time they are used. Each check raises InputError, which names the member or the returned
value and what was expected; docs/how-to/add-other-components.md has an example of each.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from rgbt.checks import InputError, check_members, described
from rgbt.requirements import record_of
from rgbt.types import IGNORE, GeneratorOf, Output, Phase, Sample

DATASET = (
    *("root", "name", "num_classes", "classes", "palette", "unscored", "background"),
    *("splits", "fingerprint", "decoding"),
)
DATASET_CALLS = {
    **{"has": ("split",), "names": ("split",), "read": ("name",), "label": ("name",)},
    **{"files": ("name",), "nights": ("names",), "fingerprint": (), "decoding": ()},
}
MODEL_CALLS = {"forward": ("rgb", "thermal", "masks", "views=", "generator=")}
STACKED = ("passes=", "num_predictions=", "num_masks=")
"""Further arguments of a network that returns masks and whose record says stacks_passes=True."""
LOSS_CALLS: dict[int, dict[str, tuple[str, ...]]] = {
    1: {"__call__": ("output", "batch", "generator")},
    2: {"__call__": ("first", "second", "warped", "valid", "generator")},
}
"""By the number of frames that the record of a loss says it takes."""
SCHEME_CALLS = {"phases": ("batch", "generator_of")}
TRANSFORM_CALLS = {"train": ("sample", "rng"), "test": ("sample",)}
EXAMPLE = ("rgb", "thermal", "label", "centre_yx", "position", "original_hw", "name", "confidence")


def is_own(part: object) -> bool:
    """Whether a component is the user's own, that is, not a class of this package."""
    return type(part).__module__.partition(".")[0] != "rgbt"


def check_dataset(dataset: Any) -> None:
    """Refuse a data set without the members of `rgbt.dataset.LabelledDataset`."""
    check_members("dataset", dataset, DATASET, DATASET_CALLS)
    for attribute in ("classes", "palette", "unscored", "background"):
        value = getattr(dataset, attribute)
        if not isinstance(value, tuple | list):
            raise InputError(
                f"dataset: {type(dataset).__name__}.{attribute} is {described(value)}; expected a "
                "tuple."
            )
    sizes = [dataset.num_classes, len(dataset.classes), len(dataset.palette)]
    if len(set(sizes)) > 1:
        raise InputError(
            f"dataset: {type(dataset).__name__} has num_classes={sizes[0]}, {sizes[1]} classes and "
            f"{sizes[2]} colours in palette; expected one of each per class."
        )


def check_first_sample(dataset: Any, split: str) -> None:
    """Refuse a data set whose first sample of a split is not a `rgbt.types.Sample`."""
    kind = type(dataset).__name__
    names = dataset.names(split)
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"dataset: {kind}.names('{split}') returned {described(names)}; expected a tuple of "
            "names, each a str."
        )
    if not names:
        raise InputError(
            f"dataset: {kind}.names('{split}') returned an empty tuple; expected at least one name."
        )
    sample = dataset.read(names[0])
    check_sample(f"dataset: {kind}.read('{names[0]}') returned", sample, names[0])
    if sample.label is None:
        return
    wrong = sample.label[(sample.label >= dataset.num_classes) & (sample.label != IGNORE)]
    if wrong.size:
        raise InputError(
            f"dataset: {kind}.read('{names[0]}') returned the label value {wrong[0]} ({wrong.size} "
            f"pixels); expected 0 to {dataset.num_classes - 1}, or {IGNORE} to ignore a pixel."
        )


def check_sample(returned: str, sample: Any, name: str) -> None:
    """Refuse anything but a `rgbt.types.Sample` of that name; `returned` begins the message."""
    if not isinstance(sample, Sample):
        raise InputError(f"{returned} {described(sample)}; expected rgbt.types.Sample.")
    if sample.name != name:
        raise InputError(f"{returned} the name '{sample.name}'; expected '{name}'.")
    hw = (*np.shape(sample.rgb), 0, 0)[:2]
    for key, shape in (("rgb", (*hw, 3)), ("thermal", hw), ("label", hw)):
        value = getattr(sample, key)
        if value is None and key == "label":
            continue
        if not isinstance(value, np.ndarray) or value.dtype != np.uint8 or value.shape != shape:
            raise InputError(
                f"{returned} {key} {described(value)}; expected ndarray "
                f"{shape if 0 not in hw else '(H, W, 3)'} uint8."
            )


def check_transform(transform: Any, sample: Sample, rng: np.random.Generator) -> None:
    """Refuse a transform whose examples are not those of `rgbt.types.Example`."""
    check_members("transform", transform, (), TRANSFORM_CALLS)
    kind = type(transform).__name__
    for method, found in (
        ("train", transform.train(sample, rng)),
        ("test", transform.test(sample)),
    ):
        missing = [key for key in EXAMPLE if not hasattr(found, key)]
        if missing:
            raise InputError(
                f"transform: {kind}.{method} returned {described(found)} without `{missing[0]}`; "
                "expected rgbt.types.Example."
            )
        hw = np.shape(found.rgb)[:2]
        shapes = {"rgb": (*hw, 3), "thermal": hw}
        for key, shape in shapes.items():
            if np.shape(getattr(found, key)) != shape:
                raise InputError(
                    f"transform: {kind}.{method} returned {key} {described(getattr(found, key))}; "
                    f"expected {shape}."
                )


def check_regions(regions: Any, image_hw: tuple[int, int]) -> None:
    """Refuse a partition that does not behave like `rgbt.metrics.metric.Regions`."""
    members = ("name", "partition", "regions", "absent")
    check_members("metric", regions, members, {"map": ("image_hw",)})
    found = regions.map(image_hw)
    fits = isinstance(found, np.ndarray) and found.dtype == np.uint8 and found.shape == image_hw
    if not fits or int(found.max()) >= regions.regions:
        raise InputError(
            f"metric: {type(regions).__name__}.map({image_hw}) returned {described(found)}"
            + (f" with values up to {int(found.max())}" if fits else "")
            + f"; expected ndarray {image_hw} uint8 of regions 0 to {regions.regions - 1}."
        )


def check_corruption(kind: Any) -> None:
    """Refuse a corruption without the members of `rgbt.corruptions.corruption.Corruption`."""
    calls = {"check": ("severity",), "__call__": ("sample", "severity", "rng_of")}
    check_members("corruption", kind, ("title", "unit", "severities"), calls)


def watch_model(model: nn.Module, num_classes: int) -> None:
    """Check the output of a user's network in its first training and evaluation pass.

    The arguments of its `forward` are checked at once.
    """
    record = record_of(model)
    stacked = STACKED if record.stacks_passes and record.outputs == "masks" else ()
    check_members("model", model, (), {"forward": (*MODEL_CALLS["forward"], *stacked)})
    left = {True, False}

    def check(
        module: nn.Module, arguments: tuple[Any, ...], keywords: dict[str, Any], found: object
    ) -> None:
        left.discard(module.training)
        if not left:
            handle.remove()
        rgb = arguments[0] if arguments else keywords["rgb"]
        _check_output(module, rgb.shape, found, num_classes)

    handle = model.register_forward_hook(check, with_kwargs=True)


def _check_output(module: nn.Module, shape: torch.Size, found: object, num_classes: int) -> None:
    returned = f"model: {type(module).__name__}.forward returned"
    expected = f"logits ({shape[0]}, {num_classes}, {shape[2]}, {shape[3]})"
    if not isinstance(found, Output):
        raise InputError(f"{returned} {described(found)}; expected Output({expected}, aux={{}}).")
    if not isinstance(found.aux, dict):
        raise InputError(f"{returned} aux {described(found.aux)}; expected a dictionary.")
    record = record_of(module)
    if record.auxiliary and "aux_logits" not in found.aux:
        raise InputError(
            f"{returned} aux without `aux_logits`, but its record says auxiliary=True."
        )
    if record.features and "features" not in found.aux:
        raise InputError(f"{returned} aux without `features`, but its record says features=True.")
    if found.logits is None and module.training and record.outputs == "masks":
        return  # its loss reads `aux`
    wanted = (shape[0], num_classes, *shape[2:])
    if not isinstance(found.logits, Tensor) or found.logits.shape != wanted:
        raise InputError(
            f"{returned} logits {described(found.logits)}; expected {expected}: one score "
            "per class and pixel of the input image."
        )


class CheckedLoss:
    """A wrapper of a user's loss that checks the first returned value against `Loss`."""

    def __init__(self, loss: Any) -> None:
        self._frames = record_of(loss).frames
        check_members("loss", loss, (), LOSS_CALLS[self._frames])
        self._loss = loss
        self._is_checked = False

    def __getattr__(self, key: str) -> Any:
        if key.startswith("_"):
            raise AttributeError(key)
        return getattr(self._loss, key)

    def __call__(self, *arguments: Any) -> Any:
        """Call the loss; check what the first call returns."""
        found = self._loss(*arguments)
        if not self._is_checked:
            name = getattr(self._loss, "__name__", f"{type(self._loss).__name__}.__call__")
            _check_parts(f"loss: {name} returned", found, dims=int(self._frames == 1))
            self._is_checked = True
        return found


class CheckedScheme:
    """A wrapper of a user's scheme whose phases may only name these `optimizers`."""

    def __init__(self, scheme: Any, optimizers: Collection[str]) -> None:
        check_members("scheme", scheme, (), SCHEME_CALLS)
        self._scheme = scheme
        self._optimizers = optimizers

    def __getattr__(self, key: str) -> Any:
        if key.startswith("_"):
            raise AttributeError(key)
        return getattr(self._scheme, key)

    def phases(self, batch: Any, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield the phases of the scheme and check each one."""
        kind = f"scheme: {type(self._scheme).__name__}.phases"
        found = self._scheme.phases(batch, generator_of)
        if not hasattr(found, "__iter__") or isinstance(found, Phase | Tensor):
            raise InputError(
                f'{kind} returned {described(found)}; expected to yield Phase(("main",), parts).'
            )
        for phase in found:
            if not isinstance(phase, Phase) or isinstance(phase.optimizers, str):
                raise InputError(
                    f'{kind} yielded {described(phase)}; expected Phase(("main",), parts).'
                )
            for name in (*phase.optimizers, *phase.idle):
                if name not in self._optimizers:
                    raise InputError(
                        f"{kind} yielded a phase with the optimizer '{name}'; expected one of: "
                        f"{', '.join(self._optimizers)}."
                    )
            _check_parts(f"{kind} yielded", phase.parts, dims=0)
            yield phase


def _check_parts(returned: str, parts: object, *, dims: int) -> None:
    """Refuse anything but a mapping of named tensors with this number of dimensions."""
    what = (
        "of shape (P,) with one value per stacked pass (loss[None] for one pass)"
        if dims
        else "scalars"
    )
    expected = f"expected a dictionary of named tensors {what}"
    if not isinstance(parts, dict) or not parts:
        raise InputError(f"{returned} {described(parts)}; {expected}.")
    for name, part in parts.items():
        if not isinstance(part, Tensor) or part.dim() != dims:
            raise InputError(f"{returned} '{name}': {described(part)}; {expected}.")
    if not any(part.requires_grad for part in parts.values()):
        raise InputError(
            f"{returned} {described(parts)}, but none of its values depends on the parameters of "
            "the network."
        )
