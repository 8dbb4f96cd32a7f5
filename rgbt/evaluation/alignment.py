"""Align the pairs of a data set: read what is known of the rig, write images, numbers, pictures."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from rgbt.checks import InputError, RunError, one_line
from rgbt.data.file_dataset import FileDataset, evenly_spaced
from rgbt.data.files import read_bytes
from rgbt.data.folder import Folder
from rgbt.data.images import grey
from rgbt.data.thermal import kind_of
from rgbt.evaluation.images import write_png
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import inside, write_json
from rgbt.geometry.alignment import (
    GRID,
    HW,
    Alignment,
    Floats,
    estimated,
    grid_of,
    moved,
    resizing,
    root_mean_square,
)
from rgbt.geometry.optical_flow import gray_of
from rgbt.geometry.rig import CALIBRATION, Rig, maps_of, of_calibration, of_homography, resampled
from rgbt.metrics.metric import Regions
from rgbt.tables import TextTable, number, without_nan
from rgbt.terminal import path_lines, plain_text, print_rich, progress, rich_table, warn
from rgbt.types import IGNORE

Side = Literal["rgb", "thermal"]
Pixels = NDArray[Any]

RINGS = Regions(partition="ring", regions=5, aspect="image", absent="exclude")

COLUMNS = ("region", "before_px", "residual_px", "standard_error_px", "points")

# Number of pairs on the sheet, width of each of its pictures, squares of a checkerboard.
WORST, PICTURE_WIDTH, SQUARES = 10, 320, 8


def align(
    dataset: FileDataset,
    out: Path,
    *,
    known: tuple[Path | None, Path | None],
    num_pairs: int,
    sides: tuple[Side, Side],
) -> int:
    """Align all pairs of a data set and print how well; `known`: files of matrix and points.

    `sides`: the image that stays as it is, and the image of the labels. See `read_rig`,
    `from_points`, `from_pairs` and `write_aligned`, whose errors are raised.
    """
    names = [n for split in dataset.splits if dataset.has(split) for n in dataset.names(split)]
    chosen = evenly_spaced(list(dict.fromkeys(names)), num_pairs)
    found: Alignment | None = None
    if known[0] is not None:
        rig, matrix = read_rig(known[0])
    else:
        found = from_pairs(dataset, chosen) if known[1] is None else from_points(known[1])
        rig, matrix = of_homography(found.matrix), found.matrix
    rgb, thermal = dataset.unaligned(chosen[0])
    if matrix is None:  # of a calibration: nearest to what the rig does
        grid = grid_of(rgb.shape[:2])
        matrix = np.asarray(cv2.findHomography(grid, rig[0](grid))[0])
    none, unknown = np.empty((0, 2)), np.full((GRID, GRID), np.nan)
    shown = found or Alignment(matrix, none, none, unknown)
    order = np.argsort(found.scores) if found and found.scores else np.arange(len(chosen))
    worst = [chosen[index] for index in order[:WORST]]
    written = write_aligned(dataset, rig, out, onto=sides[0], labels=sides[1], worst=worst)
    rows = residuals_by_region(shown, rgb.shape[:2], thermal.shape)
    regions = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
    numbers = {"H": matrix.tolist(), "regions": without_nan(regions)}
    agree = {"share_of_tiles": shown.share, "outliers": len(shown.outliers)}
    write_json(out / "alignment.json", numbers | (agree if shown.scores else {}))
    texts = tuple((name, *map(number, values), str(points)) for name, *values, points in rows)
    header = tuple(name.replace("_px", " (px)").replace("_", " ") for name in COLUMNS)
    note = "root mean square in pixels of thermal; ring 1 is the innermost"
    print_rich(rich_table(TextTable("Alignment", header, texts, (note,))))
    if found is not None and found.scores:
        say = f"{len(chosen)} pairs, {len(found.outliers)} outliers"
        print_rich(plain_text(f"estimated from {say}; {found.share:.0%} of the tiles agree"))
    if not isinstance(dataset, Folder):
        warn(f"{out}/conf has neither absent nor day and night of {dataset.name}: set both there.")
    lines = [("aligned", written), ("pictures", str(out / "worst.png"))]
    print_rich(path_lines([*lines, ("data set", f"RGBT_CONF={out / 'conf'} dataset=aligned")]))
    return 0


def read_rig(path: Path) -> tuple[Rig, Floats | None]:
    """Read H, or a calibration, from a file of OpenCV (YAML, JSON, XML); also H if it has one.

    InputError: unreadable, or neither of them.
    """
    text = read_bytes(path).decode("utf-8", "replace")
    values: dict[str, Any] = {}
    try:
        file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        for key in ("H", *CALIBRATION):
            node = file.getNode(key)
            if not node.empty():
                values[key] = node.mat() if node.isMap() else _numbers(node)
    except (cv2.error, SystemError) as error:
        raise InputError(f"matrix={path}: {one_line(error)}") from error
    if "H" not in values:
        return of_calibration(values), None
    matrix = np.asarray(values["H"], np.float64)
    if matrix.size != 9:
        raise InputError(f"matrix={path}: H has {matrix.size} numbers, expected 9.")
    return of_homography(matrix.reshape(3, 3)), matrix.reshape(3, 3)


def _numbers(node: cv2.FileNode) -> list[float]:
    """Return a number, or those of lists in lists, row by row."""
    if not node.isSeq():
        return [node.real()]
    return [number for index in range(node.size()) for number in _numbers(node.at(index))]


def from_points(path: Path) -> Alignment:
    """Fit a homography to a CSV of clicked points; InputError: unreadable, or fewer than four.

    The columns are x and y in RGB, x and y in thermal; a first line of names may be there.
    """
    text = read_bytes(path).decode("utf-8-sig", "replace")
    has_names = text.lstrip(" \"'")[:1].isalpha()
    try:
        points = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=int(has_names), ndmin=2)
    except ValueError as error:
        raise InputError(f"points={path}: {one_line(error)}") from error
    matrix = None
    if points.shape[0] >= 4 and points.shape[1] == 4 and np.isfinite(points).all():
        matrix = cv2.findHomography(points[:, :2], points[:, 2:])[0]
    if matrix is None or np.linalg.matrix_rank(matrix) < 3:
        raise InputError(
            f"points={path}: expected four lines or more of four numbers, and points that are not "
            "on one line."
        )
    unknown = np.full((GRID, GRID), np.nan)
    return Alignment(np.asarray(matrix, np.float64), points[:, :2], points[:, 2:], unknown)


def from_pairs(dataset: FileDataset, names: Sequence[str]) -> Alignment:
    """Estimate the homography from pairs; RunError if it cannot be estimated, and why."""
    pairs: list[tuple[Pixels, Pixels]] = []
    for name in names:
        rgb, thermal = dataset.unaligned(name)
        if pairs and (rgb.shape[:2], thermal.shape) != (pairs[0][0].shape, pairs[0][1].shape):
            raise InputError(f"dataset: '{name}' has another size than '{names[0]}'.")
        pairs.append((gray_of(rgb), thermal))
    found = estimated(pairs)
    why = "no tile has edges in both" if found is None else found.reason(pairs[0][0].shape)
    if found is None or why:
        raise RunError(
            f"the alignment cannot be estimated from {len(names)} pairs: {why}. Give more pairs by "
            "day (pairs=...), or points=FILE, or matrix=FILE."
        )
    return found


def residuals_by_region(found: Alignment, rgb_hw: HW, thermal_hw: HW) -> list[tuple[Any, ...]]:
    """Return `COLUMNS` of the whole image and of each ring of RGB; NaN where nothing is known.

    Root mean squares in pixels of thermal: the distance that a resize leaves, the residual of the
    points, the standard error.
    """
    grid, resize = grid_of(rgb_hw), resizing(rgb_hw, thermal_hw)
    before = np.linalg.norm(moved(found.matrix, grid) - moved(resize, grid), axis=1)
    rings = RINGS.map(rgb_hw)

    def rings_of(points: Floats) -> NDArray[Any]:
        columns, rows = (points + 0.5).astype(int).T
        at = rows.clip(0, rgb_hw[0] - 1), columns.clip(0, rgb_hw[1] - 1)
        return np.asarray(rings[at])

    of_grid, of_points = rings_of(grid), rings_of(found.points)
    rows = []
    for ring in (None, *range(RINGS.regions)):
        here = np.ones(len(grid), bool) if ring is None else of_grid == ring
        own = np.ones(len(found.points), bool) if ring is None else of_points == ring
        parts = before[here], found.residuals[own], found.uncertainty.ravel()[here]
        numbers = [root_mean_square(part) if part.size else np.nan for part in parts]
        rows.append(("image" if ring is None else f"ring {ring + 1}", *numbers, int(own.sum())))
    return rows


def write_aligned(  # noqa: PLR0913 - what is written, and how
    dataset: FileDataset, rig: Rig, out: Path, *, onto: Side, labels: Side, worst: Sequence[str]
) -> str:
    """Write aligned pairs, labels, valid masks, lists and their data set file; how many.

    Folders rgb, thermal, labels and valid (255: both cameras saw the pixel), one list a split, and
    conf/dataset/aligned.yaml. `worst` are the pairs of the sheet, worst.png.
    """
    split_names = {split: dataset.names(split) for split in dataset.splits if dataset.has(split)}
    names = tuple(dict.fromkeys(name for names in split_names.values() for name in names))
    if any(
        {path.parent.resolve() for path in dataset.files(name)} & _folders(out) for name in names
    ):
        raise InputError(f"out={out} holds the input images; choose another folder.")
    labelled, dtypes, seen = set[str](), set[str](), list[float]()
    sizes = set[tuple[Any, Any]]()  # a rig is of pixels of one size
    rows: dict[str, Pixels] = {}
    with progress() as display:
        task = display.add_task("aligning", total=len(names), note="images")
        for name in names:
            rgb, thermal = dataset.unaligned(name)
            sizes.add((rgb.shape[:2], thermal.shape))
            if len(sizes) > 1:
                raise InputError(f"dataset: '{name}' has another size than '{names[0]}'.")
            if thermal.dtype not in (np.uint8, np.uint16):  # PNG knows no other numbers
                thermal = thermal.astype(np.float32)
            pair = {"rgb": rgb, "thermal": thermal}
            images, row = _aligned(dataset, rig, name, pair, (onto, labels), name in worst)
            seen.append(float((images["valid"] > 0).mean()))
            dtypes.add(kind_of(images["thermal"]))
            if len(dtypes) > 1:
                raise InputError(f"dataset.thermal: '{name}' is of another type than the others.")
            for folder, image in images.items():
                _write(inside(out / folder / name, out), image)
            if "labels" in images:
                labelled.add(name)
            if row is not None:
                rows[name] = row
            display.advance(task)
    for split, listed in split_names.items():
        write_atomic(out / f"{split}.txt", "".join(f"{name}\n" for name in listed).encode())
    kind = "npy" if dtypes == {"float"} else "png"
    settings = _settings(dataset, out, split_names, labelled, kind)
    file = out / "conf" / "dataset" / "aligned.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(file, yaml.safe_dump(settings, sort_keys=False).encode())
    write_png(out / "worst.png", np.vstack([rows[name] for name in worst]))
    shown = f"both cameras saw {np.mean(seen):.0%} of the pixels"
    return f"{len(names)} pairs, {len(labelled)} with labels; {shown}"


def _folders(out: Path) -> set[Path]:
    return {(out / folder).resolve() for folder in ("rgb", "thermal", "labels", "valid", ".")}


def _aligned(  # noqa: PLR0913 - one pair
    dataset: FileDataset,
    rig: Rig,
    name: str,
    pair: dict[str, Pixels],
    sides: tuple[Side, Side],
    is_shown: bool,
) -> tuple[dict[str, Pixels], Pixels | None]:
    """Return the images of one pair by their folder, and its row of the sheet, if it is shown."""
    onto, labels = sides
    label = dataset.label(name) if dataset.frame(name).label else None
    hw, other_hw = pair["rgb"].shape[:2], pair["thermal"].shape
    move = rig[0]
    if onto == "thermal":
        hw, other_hw, move = other_hw, hw, rig[1]
    maps, valid = maps_of(move, hw, other_hw)
    if not valid.any():
        raise InputError(f"matrix: both cameras saw no pixel of '{name}'; H is RGB to thermal.")
    if label is not None:
        own = hw if labels == onto else other_hw
        if label.shape != own:
            raise InputError(
                f"labels={labels}: the label of '{name}' is {label.shape[0]}x{label.shape[1]}, the "
                f"image {own[0]}x{own[1]}."
            )
        label = label if labels == onto else resampled(label, maps, nearest=True)
        label = np.where(valid, label, IGNORE).astype(np.uint8)
    other: Side = "thermal" if onto == "rgb" else "rgb"
    unaligned = _shown(dataset, name, other, pair)
    before = cv2.resize(unaligned, hw[::-1], interpolation=cv2.INTER_AREA)
    pair[other] = resampled(pair[other], maps)
    row = None
    if is_shown:
        after = _shown(dataset, name, other, pair)
        row = _row(name, _shown(dataset, name, onto, pair), np.asarray(before), after)
    images = {
        "rgb": np.ascontiguousarray(pair["rgb"][..., ::-1]),
        "thermal": pair["thermal"],
        "valid": valid.astype(np.uint8) * 255,
    }
    return images | ({} if label is None else {"labels": label}), row


def _shown(dataset: FileDataset, name: str, side: Side, pair: Mapping[str, Pixels]) -> Pixels:
    """Return one image of a pair in grey levels of 8 bits."""
    if side == "rgb":
        return gray_of(pair["rgb"])
    return grey(pair["thermal"], dataset.images.limits, dataset.frame(name).thermal)


def _row(name: str, base: Pixels, before: Pixels, after: Pixels) -> Pixels:
    """Draw checkerboards and edges before and after: (h, 4 w, 3) B, G, R."""
    hw = round(PICTURE_WIDTH * base.shape[0] / base.shape[1]), PICTURE_WIDTH
    brighten = cv2.createCLAHE(4.0, (4, 4))  # for images of the night
    images = [
        np.asarray(brighten.apply(cv2.resize(image, hw[::-1], interpolation=cv2.INTER_AREA)))
        for image in (base, before, after)
    ]
    rows, columns = (np.arange(side) * SQUARES // side for side in hw)
    is_base = (rows[:, None] + columns) % 2 == 0
    outlines = [_outline(image) for image in images]
    pictures = []
    for other in images[1:]:
        mixed = np.where(is_base, images[0], other)
        pictures.append(np.repeat(mixed[..., None], 3, axis=2))
    for outline in outlines[1:]:
        faint = images[0] // 3
        green, red = np.maximum(faint, outlines[0]), np.maximum(faint, outline)
        pictures.append(np.dstack([faint, green, red]))
    sheet = np.ascontiguousarray(np.hstack(pictures))
    words = (f"{name} before", "after", "edges before: RGB green, thermal red", "after")
    for column, text in enumerate(words):
        at = (column * PICTURE_WIDTH + 4, 12)
        for colour, width in ((0, 3), (255, 1)):
            cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (colour,) * 3, width)
    return sheet


def _outline(image: Pixels) -> Pixels:
    """Return edges as grey levels: the strongest tenth is white."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    size = cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    strong = size > max(float(np.quantile(size, 0.9)), 1e-3)
    return np.asarray(strong * 255, np.uint8)


def _write(path: Path, image: Pixels) -> None:
    """Write path.png, or path.npy of real numbers."""
    if image.dtype.kind != "f":
        write_png(path.with_name(f"{path.name}.png"), image)
        return
    content = io.BytesIO()
    np.save(content, image)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path.with_name(f"{path.name}.npy"), content.getvalue())


def _settings(
    dataset: FileDataset, out: Path, splits: Mapping[str, Any], labelled: set[str], kind: str
) -> dict[str, Any]:
    """Return the data set file of aligned pairs, of class indices; 255 is ignored."""
    limits, unit = dataset.images.chosen_range, dataset.images.unit
    setting: Any = None if limits is None else list(limits)
    if unit is not None:
        setting = {"unit": unit.name or [unit.gain, unit.offset], "range": setting}
    return {
        "defaults": ["folder"],
        "root": str(out.resolve()),
        "name": f"{dataset.name}_aligned",
        "num_classes": dataset.num_classes,
        "classes": list(dataset.classes),
        "palette": [list(colour) for colour in dataset.palette],
        "unscored": list(dataset.unscored),
        "background": list(dataset.background),
        "rgb": "rgb/{name}.png",
        "thermal": f"thermal/{{name}}.{kind}",
        "label": "labels/{name}.png" if labelled else None,
        "lists": {split: f"{split}.txt" for split in splits},
        "unlabelled": [s for s, names in splits.items() if labelled.isdisjoint(names) and labelled],
        "thermal_range": setting,
        "night": dataset.night if isinstance(dataset, Folder) else None,
    }
