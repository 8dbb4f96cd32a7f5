"""How a run was made and how to repeat it, from what the run recorded at its start."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from typing import Any

from analysis.report.store import RunFiles
from rgbt.checks import InputError
from rgbt.runs.folder import read_provenance as provenance_of
from rgbt.runs.provenance import commit_of, without_passwords

COMMIT_TAG = "mlflow.source.git.commit"

NOT_REPEATED = re.compile(r"-m|--multirun|runs_dir=|out=|fresh=|\+*(tracking|hydra)[./=]")
"""Words of a command that belong to a machine, or to a grid that the run was a point of."""

PACKAGES = ("torch", "numpy", "hydra-core", "lightning-fabric", "opencv-python-headless", "rgbt")
"""Packages whose versions are shown; provenance.json has all."""

IS_GRID = re.compile(r"(range|choice|interval|glob)\(")


def repeat_command(command: str, config: Mapping[str, Any], tags: Mapping[str, str]) -> str:
    """The command that makes a run again, on any machine.

    Args:
        command: as typed; of a grid, the command of the whole grid.
        config: of the run, by dotted key: says which point of a grid it was.
        tags: of the run; the group holds what was chosen of other keys.

    Returns:
        ``python -m rgbt.run`` with the run's own overrides; "" where `command` is another one.
    """
    try:
        words = shlex.split(command)
    except ValueError:  # cut short by MLflow's limit on a tag
        return ""
    if "rgbt.run" not in words:
        return ""
    own = [w for w in words[words.index("rgbt.run") + 1 :] if not NOT_REPEATED.match(w)]
    chosen = dict(word.split("=", 1) for word in tags.get("rgbt.group", "").split() if "=" in word)
    chosen["experiment"] = tags.get("rgbt.experiment", "")
    return shlex.join(["python", "-m", "rgbt.run", *(_point(w, config, chosen) for w in own)])


def _point(word: str, config: Mapping[str, Any], chosen: Mapping[str, str]) -> str:
    """An override with the one value that this run had of several."""
    key, _, value = word.partition("=")
    if not _is_several(value):
        return word
    name = key.lstrip("+~")
    if name in config:
        return f"{key}={as_text(config[name])}"
    found = chosen.get(name) or chosen.get(name.rpartition(".")[2])
    return f"{key}={found}" if found else word


def _is_several(value: str) -> bool:
    """Whether an override's value is a grid: commas outside of brackets and quotes, a range."""
    outside = re.sub(r"'[^']*'|\"[^\"]*\"|\[[^\]]*\]|\{[^}]*\}", "", value)
    return "," in outside or IS_GRID.match(value) is not None


def as_text(value: Any) -> str:
    """A value of the configuration as one types it: ``null``, ``true``, ``[1, 2]``, ``grid``."""
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return without_passwords(text)


def read_provenance(files: RunFiles, key: str, remarks: list[str]) -> list[dict[str, Any]]:
    """Records of every process that worked on a run, oldest first; [] where nothing is known.

    Args:
        files: of the run.
        key: of the run.
        remarks: gets a sentence where the file is damaged, or where the code changed between them.
    """
    try:
        found = files.find("provenance.json")
        processes = [] if found is None else provenance_of(found)
    except InputError as error:
        remarks.append(f"Run {key}: provenance.json cannot be read ({str(error).rstrip('.')}).")
        return []
    commits = dict.fromkeys(commit_of(process) for process in processes)
    if len(commits) > 1:
        named = ", then ".join(commit or "no commit" for commit in commits)
        remarks.append(f"Run {key} was started and continued by different code: {named}.")
    return processes


def host_of(process: Mapping[str, Any]) -> str:
    """Name and devices of the machine: "vm: AMD EPYC, 2 cores"."""
    return f"{process['host']}: {hardware_of(process)}" if process.get("host") else ""


def hardware_of(process: Mapping[str, Any]) -> str:
    """GPUs, else processor and cores: "AMD EPYC, 2 cores"."""
    cpu = f"{process['cpu']}, {process.get('cpu_usable')} cores" if process.get("cpu") else ""
    return ", ".join(process.get("gpus") or []) or cpu


def versions_of(process: Mapping[str, Any]) -> dict[str, str]:
    """Versions of Python and of `PACKAGES`, where they are known."""
    packages = process.get("packages") or {}
    named = {"Python": process.get("python"), **{name: packages.get(name) for name in PACKAGES}}
    return {name: str(version) for name, version in named.items() if version}
