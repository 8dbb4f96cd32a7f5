"""Send the best checkpoint of a run to MLflow as a model that `mlflow.pyfunc.load_model` loads.

The model is a copy of two files of the run folder and the name of the module that reads them
(`rgbt.logged_model`). It holds no pickled code.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import Any

import rgbt
from rgbt.tracking.mlflow_client import MlflowStore
from rgbt.tracking.run_files import read_result
from rgbt.tracking.run_result import CHECKPOINT

NAME = "best"
"""Of the logged model."""

LOADER = "rgbt.logged_model"
"""Module whose `_load_pyfunc` opens the files."""

FILES = ("config.yaml", CHECKPOINT)


def checkpoint_digest(folder: Path) -> str:
    """SHA-256 of the best checkpoint in hexadecimal; "" where there is none."""
    path = folder / CHECKPOINT
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def send_model(store: MlflowStore, run_id: str, folder: Path, num_classes: int) -> None:
    """Log the best checkpoint as a model of the run.

    Args:
        store: open store.
        run_id: of the MLflow run.
        folder: of the finished run.
        num_classes: K.

    Raises:
        Exception: whatever MLflow raises; the model is marked as failed then.
    """
    from mlflow.entities import LoggedModelOutput

    client = store.client
    logged = client.create_logged_model(store.experiment_id, name=NAME, source_run_id=run_id)
    status = "FAILED"
    try:
        with tempfile.TemporaryDirectory() as scratch:
            made = _write(Path(scratch), folder, num_classes, (run_id, logged.model_id))
            client.log_model_artifacts(logged.model_id, str(made))
        status = "READY"
    finally:
        client.finalize_logged_model(logged.model_id, status)
    step = (read_result(folder) or {}).get("best_step", 0)
    client.log_outputs(run_id, [LoggedModelOutput(logged.model_id, step)])


def _write(scratch: Path, folder: Path, num_classes: int, identity: tuple[str, str]) -> Path:
    """The folder of the model; `identity` are the ids of run and model."""
    import mlflow.pyfunc
    import torch
    from mlflow.models import Model

    data = scratch / "run"
    data.mkdir()
    for name in FILES:
        shutil.copyfile(folder / name, data / name)
    run_id, model_id = identity
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it advises an example of the input beside the signature
        mlflow.pyfunc.save_model(
            str(scratch / "model"),
            loader_module=LOADER,
            data_path=str(data),
            mlflow_model=Model(run_id=run_id, model_id=model_id),
            signature=_signature(num_classes),
            pip_requirements=[f"rgbt=={rgbt.__version__}", f"torch=={torch.__version__}"],
        )
    return scratch / "model"


def _signature(num_classes: int) -> Any:
    import numpy as np
    from mlflow.models import ModelSignature
    from mlflow.types import ParamSchema, ParamSpec, Schema, TensorSpec

    image, scores = (-1, -1, -1), (-1, num_classes, -1, -1)
    return ModelSignature(
        inputs=Schema(
            [
                TensorSpec(np.dtype("uint8"), (*image, 3), "rgb"),
                TensorSpec(np.dtype("uint8"), image, "thermal"),
            ]
        ),
        outputs=Schema(
            [
                TensorSpec(np.dtype("uint8"), image, "labels"),
                TensorSpec(np.dtype("float32"), scores, "scores"),
            ]
        ),
        params=ParamSchema([ParamSpec("head", "string", "own")]),
    )
