"""Draw examples of a masker: ``rgbt masks +experiment=grbm out=masks.png``.

One column per training sample, augmented as in training: RGB and thermal, hidden cells in grey;
last column: how often each cell is hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig

from rgbt.checks import InputError
from rgbt.config.command import command
from rgbt.config.component import build
from rgbt.files.atomic import check_writable, replacing
from rgbt.geometry.padding import padded_hw
from rgbt.maskers.masker import check_masker
from rgbt.randomness import numpy_generator, torch_generator
from rgbt.types import AnyMasker, Example

SAMPLES, DRAWS, GREY = 5, 2000, 127


def greyed(image: NDArray[np.generic], hidden: torch.Tensor) -> NDArray[np.uint8]:
    """Copy (H, W, ...), padded at the bottom and right, grey where `hidden` (h, w) is true."""
    height, width = padded_hw((image.shape[0], image.shape[1]))
    padded = np.zeros((height, width, *image.shape[2:]), np.uint8)
    padded[: image.shape[0], : image.shape[1]] = image
    cell = np.ones((height // hidden.shape[0], width // hidden.shape[1]), bool)
    padded[np.kron(hidden.numpy(), cell)] = GREY
    return padded


def draw(masker: AnyMasker, examples: Sequence[Example], seed: int, title: str) -> Figure:
    """Draw the picture; every mask is derived from `seed`."""
    columns = len(examples) + 1
    figure = Figure(figsize=(2.6 * columns, 4.6), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False)
    for number, example in enumerate(examples):
        centre, generator = example.centre_yx, torch_generator(seed, "sketch", number)
        pair = masker(example.rgb.shape[:2], torch.tensor([centre]), generator)
        images = (example.rgb, example.thermal)
        for axis, image, mask in zip(axes[:, number], images, pair, strict=True):
            axis.imshow(greyed(image, mask[0]), cmap="gray", vmin=0, vmax=255)
            axis.plot(centre[1], centre[0], "+", color="red")
        axes[0, number].set_title(example.name, fontsize=8)
    hw, first = examples[0].rgb.shape[:2], torch.tensor([examples[0].centre_yx])
    height, width = padded_hw(hw)
    drawn = masker(hw, first.expand(DRAWS, 2), torch_generator(seed, "sketch frequency"))
    for axis, hidden, name in zip(axes[:, -1], drawn, ("RGB", "thermal"), strict=True):
        share = hidden.double().mean(0)
        axis.imshow(share.numpy(), vmin=0, vmax=1, extent=(0, width, height, 0), cmap="viridis")
        axis.set_title(f"{name} hidden, mean {share.mean():.3f}", fontsize=8)
    for axis in axes.flat:
        axis.set_axis_off()
    h, w = drawn.rgb.shape[1:]
    figure.suptitle(f"{title}: {h} x {w} cells of {height // h} x {width // w} px")
    return figure


@command()
def main(config: DictConfig, _overrides: list[str]) -> int:
    """Draw what the masker hides in training images, in the file out=masks.png."""
    path = Path(config.out or "")
    if path.suffix != ".png":
        raise InputError(f"out must be a PNG file, such as out=masks.png, got {config.out}.")
    check_writable(f"out={path}", path.parent)
    masker: AnyMasker = build(config.masker)
    dataset, transform = build(config.dataset), build(config.transform)
    examples = [
        transform.train(dataset.read(name), numpy_generator(config.seed, "sketch", index))
        for index, name in enumerate(dataset.names("train")[:SAMPLES])
    ]
    check_masker(masker, examples[0].rgb.shape[:2], torch_generator(config.seed, "probe"))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        draw(masker, examples, config.seed, config.name).savefig(file, dpi=120, format="png")
    print(path)
    return 0


if __name__ == "__main__":
    main()
