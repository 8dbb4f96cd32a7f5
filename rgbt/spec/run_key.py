"""Digests from which the key of a run is computed, and the files that they are of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.config.stored_config import targets
from rgbt.files.budgets import read_json
from rgbt.spec.source_code import user_code


def settings_digest(settings: Mapping[str, Any]) -> str:
    """12 hexadecimal digits over settings, and over the user's own code that they name."""
    code = user_code(targets(settings).values())
    text = json.dumps({**settings, **({"code": code} if code else {})}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def manifest_of(key: str, folder: str) -> dict[str, Any]:
    """The manifest of a folder of pseudo-labels.

    Raises:
        InputError: it is missing, or not finished.
    """
    path = Path(folder).expanduser() / "pseudo_labels.json"
    if not path.is_file():
        raise InputError(
            f"{key}={folder}: expected given, none, experiment:NAME/best.pt, or a folder of "
            f"finished pseudo-labels, but {path} does not exist. Write pseudo-labels with rgbt "
            "predict ... pseudo_labels=true."
        )
    manifest: dict[str, Any] = read_json(path, dict[str, Any], "remove it and predict again")
    if "digest" not in manifest:
        raise InputError(
            f"{path} does not describe pseudo-labels; choose a folder that "
            "rgbt predict ... pseudo_labels=true has written."
        )
    return manifest


def weights_file(named: str) -> Path:
    """The file that `model.weights` names; of a run folder its best checkpoint.

    Raises:
        InputError: there is no such file.
    """
    path = Path(named).expanduser()
    path = path / "best.pt" if path.is_dir() else path
    if not path.is_file():
        raise InputError(
            f"model.weights={named}: the file {path} does not exist; give a file of weights, "
            "or a run folder."
        )
    return path
