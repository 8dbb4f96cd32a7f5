"""Keep the results of runs in the repository.

usage: rgbt archive add run=all, rgbt archive check, or rgbt archive rekey

See `analysis.archive.files` for the files. Exit code 1 of ``check``: a run is damaged, or its
command now has another key.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import CommandGroup, PlainCommand

if TYPE_CHECKING:
    from analysis.archive.files import ArchivedRun

Archive = Annotated[Path, Help("folder of the archive")]


@dataclass(frozen=True)
class AddOptions:
    """Options of `add_runs`."""

    run: Annotated[str, Help("run folder or config key; all: every finished run of runs_dir")]
    runs_dir: RunsDir = Path("runs")
    archive: Archive = Path("results")


@dataclass(frozen=True)
class ArchiveOptions:
    """Options of `check` and `rekey`."""

    archive: Archive = Path("results")


def add_runs(options: AddOptions, overrides: list[str]) -> int:
    """Add finished runs to the archive; a run that is in it already is left as it is."""
    from analysis.archive.files import add
    from rgbt.runs.folder import find_run, is_finished, runs_in
    from rgbt.runs.result import RunResult
    from rgbt.terminal import plain_text, print_rich, warn

    del overrides  # none is heeded
    folders = [run.path for run in runs_in(options.runs_dir) if is_finished(run.path)]
    if options.run != "all":
        folders = [find_run(options.run, options.runs_dir)]
    for folder in folders:
        added = add(RunResult(folder), options.archive)
        print_rich(plain_text(f"{added.path}  {added.path.stat().st_size} bytes"))
        if added.path.stem != added.key:
            warn(f"{options.archive / added.key}.zip has other results; both are kept.")
    return 0


def check(options: ArchiveOptions, overrides: list[str]) -> int:
    """Compose the command of every archived run again, and report whose key has changed."""
    from rgbt.tables import TextTable
    from rgbt.terminal import print_rich, rich_table

    del overrides  # none is heeded
    found = list(_compared(options.archive))
    rows = [(each.run.path.stem, each.state, each.reason) for each in found if each.state != "same"]
    if rows:
        print_rich(rich_table(TextTable("archive", ("run", "state", "reason"), tuple(rows))))
    print_rich(f"{len(found)} runs, {len(found) - len(rows)} have the key of their command.")
    return int(bool(rows))


def rekey(options: ArchiveOptions, overrides: list[str]) -> int:
    """Rename runs whose configuration differs from today's in added settings alone.

    The default of an added setting has to keep the behaviour. Who adds it knows.
    """
    from analysis.archive.files import add
    from rgbt.runs.result import RunResult
    from rgbt.terminal import plain_text, print_rich

    del overrides  # none is heeded
    for each in [each for each in _compared(options.archive) if each.state == "added"]:
        with tempfile.TemporaryDirectory() as scratch:
            folder = each.run.unpack(Path(scratch)).folder
            _rewrite(folder, each.key, each.settings)
            new = folder.rename(folder.with_name(each.key))
            path = add(RunResult(new), options.archive).path
        each.run.path.unlink()
        print_rich(plain_text(f"{each.run.path}  ->  {path}"))
    return 0


class Compared(NamedTuple):
    """An archived run beside the run that its command requests today.

    `state` is "same" (key); "added" (another key, but only for settings that were added);
    "changed" (other settings); or "damaged", if the command does not compose any more, too.
    """

    run: ArchivedRun
    state: str
    reason: str = ""
    key: str = ""
    settings: Mapping[str, Any] = {}


def _compared(archive: Path) -> Iterator[Compared]:
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from analysis.archive.files import archived

    with tempfile.TemporaryDirectory() as scratch:
        for run in archived(archive):
            try:
                yield _compare(run, run.unpack(Path(scratch)).folder)
            except (InputError, HydraException, OmegaConfBaseException) as error:
                yield Compared(run, "damaged", str(error))


def _compare(run: ArchivedRun, folder: Path) -> Compared:
    from rgbt.config.compose import compose, flatten
    from rgbt.config.stored_config import read_settings
    from rgbt.runs.folder import read_description
    from rgbt.runs.run_spec import NOT_IN_KEY
    from rgbt.runs.specify import requested_run

    description = read_description(folder)
    words = description.overrides if description else []
    spec = requested_run(compose(words), words)
    if spec.key == run.key:
        return Compared(run, "same")
    before, now = (flatten(each) for each in (read_settings(folder / "config.yaml"), spec.plain))
    differing = [
        key
        for key in sorted(before.keys() | now.keys())
        if (key not in before or key not in now or before[key] != now[key])
        and not any(key == out or key.startswith(f"{out}.") for out in NOT_IN_KEY)
    ]
    # Nothing says how an upstream run differs.
    is_added = bool(differing) and all(key not in before for key in differing)
    reason = ", ".join(differing) or "a run that it depends on"
    return Compared(run, "added" if is_added else "changed", reason, spec.key, spec.plain)


def _rewrite(folder: Path, key: str, settings: Mapping[str, Any]) -> None:
    """Give an unpacked run its new key and settings; its counts name the run, too."""
    from omegaconf import OmegaConf

    from analysis.archive.files import counts_of
    from rgbt.files.plain_files import write_json
    from rgbt.metrics.counts import Counts
    from rgbt.runs.folder import read_result

    (folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(dict(settings))))
    write_json(folder / "result.json", {**(read_result(folder) or {}), "key": key})
    for path in counts_of(folder):
        counts = Counts.load(path)
        replace(counts, run=key if counts.run else "").save(path)


entry = CommandGroup(
    __doc__,
    {
        name: PlainCommand(options, command, heeds=(), name=f"rgbt archive {name}")
        for name, options, command in (
            ("add", AddOptions, add_runs),
            ("check", ArchiveOptions, check),
            ("rekey", ArchiveOptions, rekey),
        )
    },
)

if __name__ == "__main__":
    entry()
