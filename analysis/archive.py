"""Keep the results of runs in the repository, one small file per finished run.

usage: rgbt archive add run=all, rgbt archive check, or rgbt archive rekey

``results/<key>.zip`` holds the configuration, the result, the provenance and the counts of a run on
the test images, packed by `analysis.packing`. Unpacked, a run is a folder that
`rgbt.runs.result.RunResult` reads.

Exit code 1 of ``check``: a run is damaged, its scores are not those of its counts, or its command
now has another key. No stored word is composed (`rgbt.runs.specify.request_again`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from analysis.commands import Archive
from analysis.packing import (
    SHARED,
    digest,
    members_in,
    members_of,
    undamaged,
    write_members,
    zip_of,
)
from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import CommandGroup, PlainCommand
from rgbt.files.atomic import cache_folder, write_atomic
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder, find_run, is_finished, read_result, runs_in
from rgbt.runs.result import RunResult, check_result
from rgbt.tables import TextTable
from rgbt.terminal import plain_text, print_rich, rich_table, tracked, warn

if TYPE_CHECKING:
    from rgbt.runs.run_spec import RunSpec


def archived(folder: Path) -> list[Path]:
    """List the runs of an archive by key: ``<key>.zip``, then ``<key>-<digest>.zip``.

    The second kind has other results of the same key.
    """
    return sorted(folder.glob("*.zip"), key=lambda path: path.stem)


def key_of(path: Path) -> str:
    """Return the key of an archived run."""
    return path.stem.partition("-")[0]


def unpack(path: Path, folder: Path | None = None) -> RunResult:
    """Unpack an archived run once, as ``<digest of the file>/<key>`` in `folder`.

    `folder` None: the cache of the user. InputError: a damaged file, or one of another run.
    """
    folder, key = folder or cache_folder() / "archive", key_of(path)
    target = folder / digest(path.read_bytes()) / key
    if target.is_dir():
        return RunResult(target)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        unpacked = Path(scratch, "run")
        with undamaged(path):
            write_members(path, unpacked)
        result = RunResult(unpacked).result
        if result["key"] != key:
            raise InputError(f"{path} holds the run {result['key']}; rename the file.")
        target.parent.mkdir(exist_ok=True)
        try:
            unpacked.rename(target)
        except OSError:
            if not target.is_dir():  # another process was not faster
                raise
    return RunResult(target)


def add(run: RunResult, folder: Path) -> Path:
    """Put a finished run into the archive `folder`, and return its file.

    The same results are written once, and further counts of them are added to the file. Other
    results of the same key, from another machine, are kept beside as ``<key>-<digest>.zip``.
    InputError: the run is not finished, one of its files is damaged, or its scores are not those of
    its counts.
    """
    if not run.is_finished:
        raise InputError(f"{run.folder} is not finished; rerun its command.")
    check_result(run)
    members = members_of(run, folder / SHARED)
    path = folder / f"{run.key}.zip"
    with undamaged(path):
        old = members_in(path) if path.exists() else {}
    counted = [name for name in members if name.endswith(".xz") and name in old]
    if any(old[name] != members[name] for name in counted):
        content, old = zip_of(members), {}
        path = folder / f"{run.key}-{digest(content)[:8]}.zip"
    if not path.exists() or members.keys() - old.keys():
        write_atomic(path, zip_of({**old, **members}))
    return path


# Commands.


@dataclass(frozen=True)
class ArchiveOptions:
    """Options of `check` and `rekey`."""

    archive: Archive = Path("results")


@dataclass(frozen=True, kw_only=True)
class AddOptions(ArchiveOptions):
    """Options of `add_runs`."""

    run: Annotated[str, Help("run folder or config key; all: every finished run of runs_dir")]
    runs_dir: RunsDir = Path("runs")


def add_runs(options: AddOptions, _: list[str]) -> int:
    """Add finished runs to the archive; a run that is in it already is left as it is."""
    if options.run == "all":
        folders = [run.path for run in runs_in(options.runs_dir) if is_finished(run.path)]
    else:
        folders = [find_run(options.run, options.runs_dir)]
    for folder in folders:
        added = add(RunResult(folder), options.archive)
        print_rich(plain_text(f"{added}  {added.stat().st_size} bytes"))
        if added.stem != key_of(added):
            warn(f"{options.archive / key_of(added)}.zip has other results; both are kept.")
    return 0


def check(options: ArchiveOptions, _: list[str]) -> int:
    """Compare every archived run with its counts, and its key with that of its command today."""
    found = list(_compared(options.archive))
    rows = [(path.stem, state, why) for path, state, why, _spec in found if state != "same"]
    if rows:
        print_rich(rich_table(TextTable("archive", ("run", "state", "reason"), tuple(rows))))
    good = len(found) - len(rows)
    print_rich(f"{len(found)} runs, {good} have the scores of their counts and today's key.")
    return int(bool(rows))


def rekey(options: ArchiveOptions, _: list[str]) -> int:
    """Rename runs whose configuration differs from today's in added settings alone.

    The default of an added setting has to keep the behaviour. Who adds it knows.
    """
    from omegaconf import OmegaConf

    for path, state, _reason, spec in list(_compared(options.archive)):
        if state != "added" or spec is None:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            folder = unpack(path, Path(scratch)).folder
            RunFolder(folder).write_config(OmegaConf.to_yaml(OmegaConf.create(dict(spec.plain))))
            write_json(folder / "result.json", {**(read_result(folder) or {}), "key": spec.key})
            for name, measurement in RunResult(folder).measurements().items():
                counts = Counts.load(folder / name)
                replace(counts, measurement=replace(measurement, run=spec.key)).save(folder / name)
            added = add(RunResult(folder.rename(folder.with_name(spec.key))), options.archive)
        path.unlink()
        print_rich(plain_text(f"{path}  ->  {added}"))
    return 0


# File, state, reason and what its command requests today. The state is "same" (key); "added"
# (another key, but only for settings that were added); "changed"; or "damaged".
Compared = tuple[Path, str, str, "RunSpec | None"]


def _compared(archive: Path) -> Iterator[Compared]:
    paths = archived(archive)
    for path in tracked(paths, "runs", len(paths)):
        try:
            with tempfile.TemporaryDirectory() as scratch, undamaged(path):
                yield _compare(path, unpack(path, Path(scratch)))
        except InputError as error:
            yield path, "damaged", str(error), None


def _compare(path: Path, stored: RunResult) -> Compared:
    from rgbt.config.compose import flatten
    from rgbt.runs.run_spec import is_in_key
    from rgbt.runs.specify import request_again

    check_result(stored)
    spec = request_again(stored.settings, stored.description.overrides)
    before, now, none = flatten(stored.settings), flatten(spec.plain), object()
    # Settings of the trainer that have no name today, such as how often it saved, were in no key.
    gone = {key for key in before.keys() - now.keys() if key.startswith("trainer.")}
    keys = sorted(filter(is_in_key, (before.keys() | now.keys()) - gone))
    differing = [key for key in keys if before.get(key, none) != now.get(key, none)]
    if not differing and (spec.names_files or spec.key == stored.key):
        return path, "same", "", spec
    # Nothing says how an upstream run differs. A key of a stranger's files is not computed.
    is_added = bool(differing) and all(key not in before for key in differing)
    is_added &= not spec.names_files
    reason = ", ".join(differing) or "a run that it depends on"
    return path, "added" if is_added else "changed", reason, spec


entry = CommandGroup(
    __doc__,
    {
        "add": PlainCommand(AddOptions, add_runs, heeds=(), name="rgbt archive add"),
        "check": PlainCommand(ArchiveOptions, check, heeds=(), name="rgbt archive check"),
        "rekey": PlainCommand(ArchiveOptions, rekey, heeds=(), name="rgbt archive rekey"),
    },
)

if __name__ == "__main__":
    entry()
