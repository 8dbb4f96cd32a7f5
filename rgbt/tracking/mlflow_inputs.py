"""The data set of a run as MLflow shows it: one entry for each split that the run uses."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from rgbt.tracking.run_files import MarkerForm, read_marker

DIGEST_LENGTH = 8
"""Characters of the fingerprint that are the digest, as many as MLflow's own digests have."""

CONTEXT = "mlflow.data.context"
"""Tag of an entry that says what the run used it for."""


def inputs_digest(folder: Path) -> str:
    """SHA-256 of what the entries of a run are made of; "" where the folder does not name its data.

    Raises:
        InputError: ``dataset.json`` is damaged.
    """
    marker = read_marker(folder)
    if marker is None or "inputs" not in marker:
        return ""
    return hashlib.sha256(json.dumps(marker, sort_keys=True).encode()).hexdigest()


def send_inputs(client: Any, run_id: str, folder: Path) -> None:
    """Add the data set of a run to the column Datasets; nothing where `inputs_digest` is "".

    Name and digest together are unique in MLflow, so that each split has a name of its own.
    """
    from mlflow.entities import Dataset, DatasetInput, InputTag

    marker = read_marker(folder)
    if marker is None or "inputs" not in marker:
        return
    entries = [
        DatasetInput(
            Dataset(
                name=f"{marker['name']}/{each['split']}",
                digest=marker["files"][:DIGEST_LENGTH],
                source_type="local",  # a path as text: nothing is opened
                source=json.dumps({"uri": marker["root"]}),
                profile=_profile(marker, each["images"]),
            ),
            [InputTag(CONTEXT, each["context"])],
        )
        for each in marker["inputs"]
    ]
    client.log_inputs(run_id, datasets=entries)


def _profile(marker: MarkerForm, num_images: int) -> str:
    return json.dumps({"images": num_images, "fingerprint": marker["files"]})
