"""Find the run that a configuration requests without checking its settings.

The key of a run follows from its checked settings. The check imports every class that they name,
and with these torch, which takes seconds. So a finished run notes its key in
``<runs_dir>/.requests/<digest>.json``, under a digest of everything that the key follows from: the
resolved configuration, the user's own code, the content of weights and pseudo-labels, and the same
of the upstream runs. A request with another digest is checked as usual, and so is every request
after a change of this package.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError
from rgbt.data.domains import GIVEN, NONE
from rgbt.files.atomic import write_atomic
from rgbt.files.budgets import read_json, sealed
from rgbt.spec.checkout_code import code_of
from rgbt.spec.run_key import file_digest, manifest_of, weights_file
from rgbt.spec.run_spec import WEIGHTS, RunSpec, labels_key
from rgbt.spec.specify import parse_reference, upstream_config
from rgbt.tracking.provenance import code

FOLDER = ".requests"


@dataclass(frozen=True)
class Request:
    """What is noted of a finished run.

    Attributes:
        key: of the run.
        code: digest of the code of this package that made the key of the settings.
        uses_pretrained: `RunSpec.uses_pretrained`.
    """

    key: str
    code: str
    uses_pretrained: bool


@dataclass(frozen=True)
class KnownRun:
    """A finished run that was found by its request; its settings were checked when it was noted.

    Attributes:
        config: the composed configuration.
        overrides: as typed.
        plain: the configuration as resolved values.
        request: what is noted.
    """

    config: DictConfig
    overrides: tuple[str, ...]
    plain: Mapping[str, Any]
    request: Request

    @property
    def name(self) -> str:
        """Of the experiment."""
        return str(self.plain["name"])

    @property
    def seed(self) -> int:
        """Of the run."""
        return int(self.plain["seed"])

    @property
    def folder(self) -> Path:
        """The run folder."""
        return Path(self.plain["runs_dir"]) / self.request.key


def known_run(config: DictConfig, overrides: tuple[str, ...]) -> KnownRun | None:
    """The finished run that a configuration requests, if it was noted; torch is not imported.

    None as well for requests that need more than the finished run (`fresh`, `out`), and where
    something is wrong with the configuration, which `specify` reports.
    """
    try:
        plain = _plain(config)
        if plain.get("fresh") is not False or plain.get("out") is not None:
            return None
        path = _path(plain, request_digest(config))
    except (InputError, OmegaConfBaseException):
        return None
    if not path.is_file():
        return None
    request: Request = read_json(path, Request, "remove it")
    if request.code != code()["code"]:
        return None
    known = KnownRun(config, overrides, {**plain, "fresh": False}, request)
    return known if (known.folder / "result.json").is_file() else None


def note_request(config: DictConfig, spec: RunSpec) -> None:
    """Note the key of a finished run under what requested it."""
    request = Request(spec.key, code()["code"], spec.uses_pretrained)
    path = _path(spec.plain, request_digest(config))
    path.parent.mkdir(exist_ok=True)
    write_atomic(path, json.dumps(sealed(vars(request))).encode())


def request_digest(config: DictConfig, downstream: tuple[str, ...] = ()) -> str:
    """SHA-256 in hexadecimal over everything that the key of a run follows from.

    Args:
        config: composed.
        downstream: names of the experiments whose upstream run this is.

    Raises:
        InputError: a file or folder is missing, or upstream runs make a cycle.
    """
    plain = _plain(config)
    content = {
        "config": {**plain, "fresh": False},
        "own_code": sorted(code_of(plain).items()),
        "sets": [
            file_digest(Path(name).expanduser())
            for name in plain["consistency"].get("sets") or ()
            if Path(name).expanduser().is_file()
        ],
    }
    for key in (WEIGHTS, labels_key("source"), labels_key("target")):
        value = OmegaConf.select(config, key)
        reference = parse_reference(key, value)
        if reference is not None:
            names = (*downstream, str(plain["name"]))
            if reference.experiment in names:
                raise InputError(f"{key} makes a cycle of upstream runs.")
            upstream = upstream_config(config, key, reference)
            content[key] = request_digest(upstream, names)
        elif value not in (None, GIVEN, NONE):
            is_file = key == WEIGHTS
            content[key] = (
                file_digest(weights_file(value)) if is_file else manifest_of(key, value)["digest"]
            )
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _path(plain: Mapping[str, Any], digest: str) -> Path:
    return Path(plain["runs_dir"]) / FOLDER / f"{digest[:16]}.json"


def _plain(config: DictConfig) -> dict[str, Any]:
    return cast("dict[str, Any]", OmegaConf.to_container(config, resolve=True))
