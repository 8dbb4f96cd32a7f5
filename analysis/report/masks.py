"""Examples of the masks that the runs were trained with, small enough to be part of the page."""

from __future__ import annotations

import base64
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.report.data import PagePicture
from analysis.report.runs import ReportRun
from analysis.report.tables import Track
from rgbt.checks import InputError
from rgbt.config.stored_config import check_targets

MOST = 8
"""Pictures on the page."""

DRAWS = 3
"""Masks of one masker, side by side."""

WIDTH = 640
"""Pixels of a picture."""

MOST_BYTES = 30_000
"""Of an encoded picture: in base64 it becomes a third longer, 40 kB."""

QUALITIES = (80, 60, 40, 20, 5)
GAP = 4
SETTINGS = ("sampler", "patch_size", "ratio", "sigma_div", "anchor", "pairing")


@dataclass(frozen=True)
class MaskerInUse:
    """A masker in use.

    Attributes:
        masker: its node of the configuration.
        dataset: the node of the data set that its first run saw.
        groups: methods that were trained with it.
        runs: their number.
    """

    masker: Mapping[str, Any]
    dataset: Mapping[str, Any]
    groups: tuple[str, ...]
    runs: int


def mask_pictures(
    runs: Iterable[ReportRun], track: Track, remarks: list[str], trust: Collection[str] = ()
) -> tuple[PagePicture, ...]:
    """One picture per masker that hides anything, those of the most runs first.

    Args:
        runs: of the store.
        track: shows how far it is.
        remarks: gets a sentence for each that cannot be drawn, and for those beyond `MOST`.
        trust: modules that their configurations may name (`rgbt.config.stored_config`).
    """
    maskers = maskers_in_use(runs)
    if len(maskers) > MOST:
        remarks.append(f"Masks of {MOST} maskers are shown; {len(maskers) - MOST} more were used.")
    pictures = []
    for masked in track(maskers[:MOST], "masks"):
        try:
            pictures.append(picture(masked, remarks, trust))
        except (InputError, OSError) as error:
            remarks.append(f"Masks of '{masked.groups[0]}' cannot be drawn: {error}")
    return tuple(pictures)


def maskers_in_use(runs: Iterable[ReportRun]) -> list[MaskerInUse]:
    """Distinct maskers, those of the most runs first."""
    found: dict[str, list[tuple[ReportRun, Mapping[str, Any], Mapping[str, Any]]]] = {}
    for run in runs:
        masker, dataset = (
            {
                k.removeprefix(f"{name}."): v
                for k, v in run.config.items()
                if k.startswith(f"{name}.")
            }
            for name in ("masker", "dataset")
        )
        if masker and dataset and masker.get("sampler") != "none":
            found.setdefault(json.dumps(masker, sort_keys=True), []).append((run, masker, dataset))
    maskers = []
    for users in found.values():
        groups = tuple(dict.fromkeys(run.entry.group for run, _, _ in users))
        maskers.append(MaskerInUse(users[0][1], users[0][2], groups, len(users)))
    return sorted(maskers, key=lambda masked: (-masked.runs, masked.groups))


def picture(masked: MaskerInUse, remarks: list[str], trust: Collection[str] = ()) -> PagePicture:
    """Draws of one masker: RGB above, thermal below, hidden pixels coloured.

    Raises:
        InputError: the masker is not trusted, cannot be built, or does not fit the images.
    """
    from analysis.figures.masks import mask_examples, whole_cells

    check_targets({"masker": masked.masker}, trust, "its config.yaml", "masker")
    masker = _built("masker", masked.masker)
    node = masked.dataset
    try:
        check_targets({"dataset": node}, trust, "its config.yaml", "dataset")
    except InputError as error:
        remarks.append(f"Masks of '{masked.groups[0]}' are drawn on the embedded data set: {error}")
        node = {}
    sample, source = _sample(node)
    draws = {str(index): masker for index in range(DRAWS)}
    size = masked.masker.get("patch_size")
    multiple = whole_cells([size] if isinstance(size, int) else [])
    examples = mask_examples(sample, draws, multiple, seed=0)
    image = _beside([np.vstack([each.rgb, each.thermal]) for each in examples])
    hidden = [
        np.mean([getattr(each, name).mean() for each in examples])
        for name in ("rgb_hidden", "thermal_hidden")
    ]
    chosen = ", ".join(
        f"{name} {masked.masker[name]}" for name in SETTINGS if masked.masker.get(name) is not None
    )
    return PagePicture(
        title=masked.groups[0],
        caption=(
            f"{chosen}; {masked.runs} run{'s' * (masked.runs > 1)}. {DRAWS} draws on {source}, RGB "
            f"above and thermal below; here {hidden[0]:.0%} of RGB and {hidden[1]:.0%} of thermal "
            "are hidden."
        ),
        address=data_address(image),
        width=image.shape[1],
        height=image.shape[0],
    )


def _sample(node: Mapping[str, Any]) -> tuple[Any, str]:
    """A pair of the data set, or of the embedded one where its files are not here."""
    from omegaconf import OmegaConf

    from rgbt.config.compose import compose

    try:
        dataset, where = _built("dataset", node), ""
        sample = dataset.read(name := dataset.names("val")[0])
    except (InputError, OSError):
        embedded: Any = OmegaConf.to_container(compose([]).dataset, resolve=True)
        dataset, where = _built("dataset", embedded), " of the embedded data set"
        sample = dataset.read(name := dataset.names("val")[0])
    return sample, f"'{name}'{where}"


def _built(name: str, values: Mapping[str, Any]) -> Any:
    from omegaconf import OmegaConf

    from rgbt.config.component import build

    return build(OmegaConf.create({name: dict(values)})[name])


def _beside(columns: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Columns with a white gap between them, together at most `WIDTH` pixels wide."""
    import cv2

    height, width = columns[0].shape[:2]
    target = min(width, (WIDTH - GAP * (len(columns) - 1)) // len(columns))
    size = (target, round(height * target / width))
    small = [cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in columns]
    gap = np.full((size[1], GAP, 3), 255, np.uint8)
    parts = [part for each in small for part in (each, gap)][:-1]
    return np.hstack(parts).astype(np.uint8)


def data_address(rgb: NDArray[np.uint8]) -> str:
    """An image (H, W, 3) uint8 as a WebP inside an address of at most 40 kB.

    What does not fit at any quality is halved.
    """
    import cv2

    for quality in QUALITIES:
        done, encoded = cv2.imencode(".webp", rgb[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])
        assert done, "OpenCV comes with WebP"
        if encoded.size <= MOST_BYTES:
            return "data:image/webp;base64," + base64.b64encode(encoded.tobytes()).decode()
    half = (max(1, rgb.shape[1] // 2), max(1, rgb.shape[0] // 2))
    return data_address(cv2.resize(rgb, half, interpolation=cv2.INTER_AREA).astype(np.uint8))
