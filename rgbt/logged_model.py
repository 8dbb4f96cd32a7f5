"""What `mlflow.pyfunc.load_model` loads: the best checkpoint of a run that predicts arrays.

MLflow calls `_load_pyfunc` with the folder of a logged model (`rgbt.tracking.mlflow_model`): the
configuration and the weights of a run. They are read like those of any run, without executing
anything, and no data set is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.build.load_run import trusted_settings
from rgbt.build.session import open_fabric
from rgbt.checks import InputError, check_choice
from rgbt.class_scores import classes_of
from rgbt.config.stored_config import parse_trust
from rgbt.data.batches import collate
from rgbt.data.domains import TestedHead
from rgbt.engine.checkpoint import load_checkpoint, restore_weights
from rgbt.engine.evaluate import label_scores
from rgbt.engine.network_settings import place
from rgbt.requirements import record_of
from rgbt.spec.load_spec import load_spec
from rgbt.tracking.run_result import CHECKPOINT
from rgbt.types import Sample


class LoggedNetwork:
    """A network with its weights that predicts batches of arrays.

    Args:
        folder: with config.yaml and best.pt.
        overrides: of the configuration, such as "trainer.accelerator=cpu".
        trust: modules that the configuration may name.

    Raises:
        InputError: a target that is not trusted, overrides or weights that do not fit.
    """

    def __init__(self, folder: Path, overrides: list[str], trust: str) -> None:
        settings = trusted_settings(folder, parse_trust(trust))
        self.spec = load_spec(settings, ["trainer.accelerator=auto", *overrides])
        self._fabric = open_fabric(self.spec.trainer)
        network = self.spec.model.build()
        payload = load_checkpoint(folder / CHECKPOINT)
        restore_weights(network, payload["model"], folder / CHECKPOINT)
        self._network = place(network.eval(), self._fabric.device, self.spec.trainer)
        self._transform = self.spec.transform.build()
        self._view = self.spec.domains.source.view or record_of(network).views[0]

    def predict(
        self, model_input: Mapping[str, NDArray[np.uint8]], params: Mapping[str, Any] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Labels and class scores of image pairs.

        Args:
            model_input: "rgb", (B, H, W, 3) uint8 in the order red, green, blue, and "thermal",
                (B, H, W) uint8 grey levels.
            params: "head": "own", "source" or "target", of a network with one head per domain.

        Returns:
            "labels", (B, H, W) uint8, the class with the highest score; "scores", (B, K, H, W)
            float32.

        Raises:
            InputError: other arrays, or a head that the network does not have.
        """
        rgb, thermal = _images(model_input)
        choice = (params or {}).get("head", "own")
        check_choice("head", choice, get_args(TestedHead))
        head = self.spec.domains.head_of(self._view, None, choice)
        found = []
        for index, pair in enumerate(zip(rgb, thermal, strict=True)):
            example = self._transform.test(Sample(*pair, None, f"image {index}"))
            batch = collate([example], "").to(self._fabric.device)
            how = (self._fabric, self._view, (head,), self.spec.prediction)
            found.append(label_scores(self._network, batch, *how).cpu())
        return {
            "labels": np.concatenate([classes_of(each).numpy().astype(np.uint8) for each in found]),
            "scores": np.concatenate([each.numpy() for each in found]),
        }


def _images(model_input: Any) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The two arrays of an input; InputError where they do not fit."""
    given = model_input if isinstance(model_input, Mapping) else {}
    rgb, thermal = given.get("rgb"), given.get("thermal")
    if isinstance(rgb, np.ndarray) and isinstance(thermal, np.ndarray):
        are_bytes = (rgb.dtype, thermal.dtype) == (np.uint8, np.uint8)
        if are_bytes and rgb.ndim == 4 and rgb.shape == (*thermal.shape, 3) and rgb.size:
            return rgb, thermal
    raise InputError(
        "expected a mapping with 'rgb', (B, H, W, 3) uint8, and 'thermal', (B, H, W) uint8, of "
        "equal B, H and W."
    )


def _load_pyfunc(data_path: str, model_config: Mapping[str, Any] | None = None) -> LoggedNetwork:
    """Called by MLflow; `model_config` may have "overrides", a list, and "trust", a text."""
    options = model_config or {}
    overrides = [str(each) for each in options.get("overrides", [])]
    return LoggedNetwork(Path(data_path), overrides, str(options.get("trust", "")))
