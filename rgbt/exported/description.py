"""What an exported file says about itself: names and values beside the graph."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rgbt.checks import InputError, one_line
from rgbt.files.plain_files import parse_json
from rgbt.requirements import Outputs
from rgbt.types import View

PREFIX = "rgbt."
"""Of every name in the metadata of a file."""

PACKAGES = ("onnx", "onnxruntime", "onnxscript")
"""What the optional extra `export` installs."""

RGB = "float32, (batch, 3, height, width), R, G, B in [0, 1]"
THERMAL = "float32, (batch, 1, height, width), grey level in [0, 1]"
"""Inputs of every exported graph; its own normalisation is inside."""


@dataclass(frozen=True, kw_only=True)
class Description:
    """The metadata of an exported network.

    Attributes:
        version: of rgbt.
        network: class of the network.
        run: key of the run, or name of the file of weights.
        step: optimiser step of the weights; 0 where it is not known.
        dataset: name of the data set.
        fingerprint: of its files.
        classes: names, in the order of the scores.
        view: input images that the graph uses; the other image is an input too and is ignored.
        head: of a network with one head per domain; None: it has one for all images.
        outputs: whether the scores are of classes, or sums over masks of queries.
        image_hw: height and width of the images.
        opset: version of the ONNX operators.
        rgb: what the first input is.
        thermal: what the second input is.
        settings: configuration of the run, without tracking: how images are read and predicted.
    """

    version: str
    network: str
    run: str
    step: int
    dataset: str
    fingerprint: str
    classes: tuple[str, ...]
    view: View
    head: str | None
    outputs: Outputs
    image_hw: tuple[int, int]
    opset: int
    settings: dict[str, Any]
    rgb: str = RGB
    thermal: str = THERMAL

    def to_metadata(self) -> dict[str, str]:
        """Name -> text as JSON, in the form that ONNX files hold."""
        return {f"{PREFIX}{key}": json.dumps(value) for key, value in asdict(self).items()}

    @classmethod
    def from_metadata(cls, path: Path, metadata: Mapping[str, str]) -> Description:
        """The description in the metadata of the file `path`.

        Raises:
            InputError: there is none, or it is damaged.
        """
        own = {k.removeprefix(PREFIX): v for k, v in metadata.items() if k.startswith(PREFIX)}
        if not own:
            raise InputError(
                f"{path} was not written by rgbt: it does not hold classes and settings. Export "
                "the network with rgbt export run=... out=..."
            )
        try:
            text = json.dumps({key: json.loads(value) for key, value in own.items()})
            found: Description = parse_json(text, cls)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path}: its description is damaged ({one_line(error)}); export the network again."
            ) from error
        return found


def require_packages() -> None:
    """Refuse where the packages of the extra are missing.

    Raises:
        InputError: naming the missing packages and the extra.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"ONNX files require the package{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            "install the extra: pip install 'rgbt[export]'."
        )
