"""Predict images with a trained network: ``python -m rgbt.predict run=... input=... out=folder``.

For every image a colour overlay and a PNG of class indices are written.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.command import plain_command

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rgbt.session import Session
    from rgbt.types import Sample, View

OWN = {"run": "", "input": None, "out": None, "runs_dir": "runs", "modality": "default"}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Write NAME_overlay.png and NAME.png (class indices, 0..K-1) for every input image.

    run       run folder, config key or MLflow run id; without one, name a network and its weights:
              model=mfnet model.weights=final.pth dataset.root=/data/MFNet (scale=paper)
    input     a 4-channel PNG (R, G, B, thermal), a folder of such, or a split of the data set
    out       folder, made where it is missing
    modality  rgbt, rgb or thermal: what is predicted from; default: what the network is made for
    overrides such as dataset=mfnet dataset.root=/data/MFNet
    """
    import numpy as np

    from rgbt.engine.progress import progress
    from rgbt.session import view_of
    from rgbt.stored import open_trained
    from rgbt.tracking.pictures import overlay

    session = open_trained(arguments["run"], Path(arguments["runs_dir"]), overrides).session
    view = view_of(session.model, arguments["modality"])
    samples, total = _samples(session, arguments["input"])
    out = Path(arguments["out"])
    if out.resolve() in (
        Path(arguments["input"]).resolve(),
        Path(arguments["input"]).parent.resolve(),
    ):
        raise InputError(
            f"out={out} holds the input images, which would be overwritten; take another."
        )
    out.mkdir(parents=True, exist_ok=True)
    palette = np.array(session.dataset.palette, np.uint8)
    with progress() as display:
        task = display.add_task("predicting", total=total, note="images")
        for sample, classes in _classes(session, samples, view):
            painted = overlay(sample.rgb, classes, palette)
            _write(out / f"{sample.name}_overlay.png", painted[..., ::-1])
            _write(out / f"{sample.name}.png", classes)
            display.advance(task)
    print(f"{total} images in {out.resolve()}")
    return 0


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    import cv2

    if not cv2.imwrite(str(path), image):
        raise InputError(f"{path} could not be written; is the folder writable, the disk full?")


def _classes(
    session: Session, samples: Iterable[Sample], view: View
) -> Iterator[tuple[Sample, NDArray[np.uint8]]]:
    from rgbt.data.batches import collate
    from rgbt.engine.evaluate import predictions

    for sample in samples:
        # One image at a time: a folder may hold images of any size.
        batch = collate([session.transform.test(sample)], "")
        for found in predictions(session.model, [batch], session.fabric, view):
            yield sample, found.classes[0].numpy()


def _samples(session: Session, source: str) -> tuple[Iterator[Sample], int]:
    """The images that `source` names, and how many they are."""
    from rgbt.data.files import read_packed
    from rgbt.types import Sample

    dataset, path = session.dataset, Path(source)
    if source in dataset.splits:
        names = dataset.names(source)
        return (dataset.read(name) for name in names), len(names)
    files = sorted(path.glob("*.png")) if path.is_dir() else [path]
    if not path.exists() or not files:
        raise InputError(
            f"input={source}: expected a 4-channel PNG, a folder that holds some, or a split of "
            f"{dataset.name} ({', '.join(dataset.splits)})."
        )

    def read(file: Path) -> Sample:
        rgb, thermal = read_packed(file)
        return Sample(rgb=rgb, thermal=thermal, label=None, name=file.stem)

    return map(read, files), len(files)


if __name__ == "__main__":
    plain_command(OWN, main)()
