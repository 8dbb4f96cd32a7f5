"""Draw examples of a masker: ``rgbt masks +experiment=grbm out=masks.png``.

One column per training sample, augmented as in training: RGB and thermal with their hidden cells
greyed out; last column: how often each cell is hidden. A picture to look at, not a measurement.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig

from rgbt.checks import InputError
from rgbt.config.command import command
from rgbt.config.component import build
from rgbt.geometry.padding import padded_hw
from rgbt.maskers.contract import check_masker
from rgbt.randomness import numpy_generator, torch_generator
from rgbt.types import AnyMasker, Example

SAMPLES = 5
DRAWS = 2000
GREY = 127


class Sketch(NamedTuple):
    """The data of the picture.

    Attributes:
        names: B names of samples.
        rgb: B images (H, W, 3) uint8, padded, hidden cells grey.
        thermal: B images (H, W) uint8, padded, hidden cells grey.
        centres: B pixels (row, column) nearest to the centre of the original image.
        rgb_frequency: (h, w), share of draws in which a cell of RGB is hidden, for `centres[0]`.
        thermal_frequency: the same for thermal.
    """

    names: tuple[str, ...]
    rgb: tuple[NDArray[np.uint8], ...]
    thermal: tuple[NDArray[np.uint8], ...]
    centres: tuple[tuple[int, int], ...]
    rgb_frequency: NDArray[np.float64]
    thermal_frequency: NDArray[np.float64]


def sketch(masker: AnyMasker, examples: Iterable[Example], seed: int, draws: int = DRAWS) -> Sketch:
    """Masked images of training examples, and how often each cell is hidden.

    Every mask is derived from `seed`; the frequencies are those of `draws` masks for the centre of
    the first example.
    """
    shown = tuple(examples)
    centres = torch.tensor([example.centre_yx for example in shown])
    sizes = [(example.rgb.shape[0], example.rgb.shape[1]) for example in shown]
    pairs = [
        masker(image_hw, centres[index : index + 1], torch_generator(seed, "sketch", index))
        for index, image_hw in enumerate(sizes)
    ]
    generator = torch_generator(seed, "sketch frequency")
    many = masker(sizes[0], centres[:1].expand(draws, 2), generator)
    return Sketch(
        names=tuple(example.name for example in shown),
        rgb=tuple(_greyed(e.rgb, pair.rgb) for e, pair in zip(shown, pairs, strict=True)),
        thermal=tuple(
            _greyed(e.thermal, pair.thermal) for e, pair in zip(shown, pairs, strict=True)
        ),
        centres=tuple(example.centre_yx for example in shown),
        rgb_frequency=many.rgb.double().mean(0).numpy(),
        thermal_frequency=many.thermal.double().mean(0).numpy(),
    )


def draw(data: Sketch, title: str) -> Figure:
    """The picture of `data`, drawn without a display."""
    columns = len(data.names) + 1
    figure = Figure(figsize=(2.6 * columns, 4.6), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False)
    for column, name in enumerate(data.names):
        centre = data.centres[column]
        _draw_image(axes[0, column], data.rgb[column], centre, name)
        _draw_image(axes[1, column], data.thermal[column], centre, "")
    image_hw = data.thermal[0].shape
    _draw_frequency(axes[0, -1], data.rgb_frequency, image_hw, "RGB")
    _draw_frequency(axes[1, -1], data.thermal_frequency, image_hw, "thermal")
    figure.suptitle(title)
    return figure


def _greyed(image: NDArray[np.generic], hidden: torch.Tensor) -> NDArray[np.uint8]:
    """Copy of `image`, padded at the bottom and right, grey where `hidden` (1, h, w) says so."""
    height, width = padded_hw((image.shape[0], image.shape[1]))
    padded = np.zeros((height, width, *image.shape[2:]), np.uint8)
    padded[: image.shape[0], : image.shape[1]] = image
    mask = hidden[0].numpy()
    cell = np.ones((height // mask.shape[0], width // mask.shape[1]), bool)
    padded[np.kron(mask, cell)] = GREY
    return padded


def _draw_image(
    axes: Axes, image: NDArray[np.uint8], centre_yx: tuple[int, int], name: str
) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.plot(centre_yx[1], centre_yx[0], "+", color="red")
    axes.set_title(name, fontsize=8)
    axes.set_axis_off()


def _draw_frequency(
    axes: Axes, frequency: NDArray[np.float64], image_hw: tuple[int, ...], name: str
) -> None:
    extent = (0, image_hw[1], image_hw[0], 0)
    axes.imshow(frequency, vmin=0, vmax=1, extent=extent, cmap="viridis")
    axes.set_title(f"{name} hidden, mean {frequency.mean():.3f}", fontsize=8)
    axes.set_axis_off()


@command()
def main(config: DictConfig, _overrides: list[str]) -> int:
    """Write the picture of the configured masker to `out`."""
    path = Path(config.out or "")
    if path.suffix != ".png":
        raise InputError(
            "out must be the path of a PNG file to write, for example out=masks.png, got "
            f"{config.out}."
        )
    masker: AnyMasker = build(config.masker)
    dataset, transform = build(config.dataset), build(config.transform)
    names = dataset.names("train")[:SAMPLES]
    examples = [
        transform.train(dataset.read(name), numpy_generator(config.seed, "sketch", index))
        for index, name in enumerate(names)
    ]
    shape = examples[0].rgb.shape
    check_masker(masker, (shape[0], shape[1]), torch_generator(config.seed, "probe"))
    found = sketch(masker, examples, config.seed)
    cells, pixels = found.rgb_frequency.shape, found.thermal[0].shape
    sides = " x ".join(f"{n // k}" for n, k in zip(pixels, cells, strict=True))
    title = f"{config.name}: {type(masker).__name__}, {cells[0]} x {cells[1]} cells of {sides} px"
    path.parent.mkdir(parents=True, exist_ok=True)
    draw(found, title).savefig(path, dpi=120)
    print(path)
    return 0


if __name__ == "__main__":
    main()
