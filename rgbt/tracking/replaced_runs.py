"""Keep finished runs that another training of the same key replaces (``fresh=true``).

They move to ``<runs_dir>/replaced/<key>-<n>`` and can be opened by their folder (run=FOLDER).
Commands that collect the runs of a folder do not count them as another seed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rgbt.tracking.run_files import Description, read_description, read_result
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.terminal import info
from rgbt.tracking.tracker import Tracking

REPLACED = "replaced"
TAG = "rgbt.replaced"
GROUP = "rgbt.group"


def set_aside(folder: RunFolder) -> RunFolder | None:
    """Move a finished run away from its key.

    Returns:
        its new folder; None where the run is not finished, or not any more.

    Raises:
        InputError: a process is training there.
    """
    with folder.lock():
        if read_result(folder.path) is None:
            return None
        number = 1
        while _replaced_path(folder, number).exists():
            number += 1
        _replaced_path(folder, number).parent.mkdir(exist_ok=True)
        folder.path.rename(_replaced_path(folder, number))
    return RunFolder(_replaced_path(folder, number))


def replace_finished(folder: RunFolder, tracking: Tracking) -> None:
    """Set a finished run aside and show it so in its tracker."""
    kept = set_aside(folder)
    known = None if kept is None else read_description(kept.path)
    if kept is None or known is None:
        return
    tracking.refresh(kept, known)
    info(f"the finished run was moved to {kept.path}; open it with run={kept.path}.")


def runs_dir_of(folder: RunFolder) -> Path:
    """The folder of runs that a run belongs to, replaced or not."""
    return folder.path.parents[1 if _is_replaced(folder) else 0]


def shown_key(folder: RunFolder) -> str:
    """The key of a run as a tracker shows it: `<key>`, or `replaced/<key>-<n>`."""
    name = folder.path.name
    return f"{REPLACED}/{name}" if _is_replaced(folder) else name


def shown_description(folder: RunFolder) -> Description | None:
    """How a tracker shows a run; a replaced one is in no group, and its key is its folder."""
    known = read_description(folder.path)
    if known is None or not _is_replaced(folder):
        return known
    tags = {
        **known.tags,
        TAG: "true",
        GROUP: f"{known.tags.get(GROUP, known.name)} (replaced)",
        "rgbt.key": shown_key(folder),
    }
    return replace(known, name=f"{known.name} (replaced)", tags=tags)


def _is_replaced(folder: RunFolder) -> bool:
    return folder.path.parent.name == REPLACED


def _replaced_path(folder: RunFolder, number: int) -> Path:
    return folder.path.parent / REPLACED / f"{folder.path.name}-{number}"
