"""Show the result of a finished run, without torch and without its store where both can be avoided.

Torch is needed where the consistency of the run is measured on virtual views. The store is needed
where it lacks something of the run (`Tracking.refresh`).
"""

from __future__ import annotations

from collections.abc import Mapping

from rich.text import Text

from rgbt.checks import InputError
from rgbt.runs.folder import (
    GROUP,
    Description,
    RunFolder,
    read_description,
    read_result,
    read_tables,
)
from rgbt.runs.naming import describe
from rgbt.runs.provenance import warn_of_result
from rgbt.runs.run_spec import RunSpec
from rgbt.tables import percent, subset_mious
from rgbt.terminal import info, print_rich, result_view
from rgbt.tracking.tracker import Tracking


def show(run: RunSpec, extra_tags: Mapping[str, str] | None = None) -> None:
    """Print the tables of a finished run, and what differs from the run that is requested now.

    Args:
        run: the requested run, which is finished.
        extra_tags: MLflow tags of the request.
    """
    folder, tracking = RunFolder(run.folder), run.tracking.build()
    folder.clean()
    requested, known = describe(run, extra_tags), read_description(folder.path)
    assert known is not None, "a finished run has its description"
    info(
        f"{requested.name} is already finished; its result follows. For a new run, choose "
        "another value of seed=..."
    )
    # A point of a grid may be the default of an experiment: the longer name says what it varies.
    lengths = [len(each.tags.get(GROUP, "")) for each in (requested, known)]
    named = requested if lengths[0] > lengths[1] else known
    merged = Description(named.name, {**known.tags, **named.tags}, known.params)
    tracking.refresh(folder, merged)
    warn_of_result(folder.path)
    _report_other_files(run, folder)
    _report_consistency(run, folder)
    print_result(run, folder, tracking)


def print_result(run: RunSpec, folder: RunFolder, tracking: Tracking) -> None:
    """Print the tables of a finished run, its folder and how its pages are opened."""
    tables = read_tables(folder.path)
    assert tables is not None, "a finished run has its tables"
    heads = run.domains.heads_in_words(run.domains.tested_head)
    links = [*([("heads", heads)] if heads else []), *tracking.links()]
    print_rich(result_view(tables, folder.path, links))


def print_upstream_result(folder: RunFolder, name: str) -> None:
    """Print the scores and the folder of a finished upstream run in one line."""
    tables = read_tables(folder.path)
    assert tables is not None, "a finished run has its tables"
    values = {"mIoU": tables.regions.miou, **subset_mious(tables.classes)}
    found = ", ".join(f"{part} {percent(value)}" for part, value in values.items())
    print_rich(Text(f"upstream run {name}: {found}  {folder.path}"))


def _report_other_files(run: RunSpec, folder: RunFolder) -> None:
    """Report a finished run of the same key that was made on another copy of the data set."""
    if "root" not in run.plain["dataset"]:
        return  # drawn from its settings alone, which are in the key
    result = read_result(folder.path)
    try:
        now = run.dataset.build().fingerprint()
    except InputError:
        return  # a result can be shown without its data
    if result is not None and result["dataset"] != now:
        info(
            f"this run was trained on other files of the data set ({result['dataset'][:8]}, now "
            f"{now[:8]}). To train on the present files, set runs_dir=... or dataset.name=..."
        )


def _report_consistency(run: RunSpec, folder: RunFolder) -> None:
    """Report a request for views on which the run was not measured."""
    if not run.plain["consistency"]["sets"]:
        return
    from rgbt.metrics.pairs import file_name  # NumPy

    views = run.consistency.build()
    measured = [folder.path / file_name("aligned", each, views.mark) for each in views.splits]
    if not all(path.is_file() for path in measured):
        info(
            "the consistency of this run has not been measured on these views and splits. To "
            f"measure it: rgbt consistency run={folder.path} split=..."
        )
