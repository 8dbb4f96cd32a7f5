"""Show the result of a finished run, without torch and without its store where both can be avoided.

Torch is needed where the consistency of the run is measured on virtual views. The store is needed
where it lacks something of the run (`Tracking.refresh`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from rgbt.checks import InputError
from rgbt.config.component import Component
from rgbt.data.domains import Domains
from rgbt.spec.naming import describe, group_of
from rgbt.spec.request import KnownRun, known_run
from rgbt.spec.run_spec import RunSpec
from rgbt.tracking.other_code import warn_of_result
from rgbt.tracking.run_files import Description, read_description, read_result, read_tables
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.tables import percent, subset_mious
from rgbt.tracking.terminal import info, print_rich, result_view
from rgbt.tracking.tracker import Tracking

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from rgbt.dataset import LabelledDataset
    from rgbt.transforms.view_sets import ViewSets

LAUNCHED = ("RANK", "SLURM_PROCID")
"""Variables of processes that were started together for one run; one of them shows it."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished run and how its result is shown.

    Attributes:
        folder: the run folder.
        requested: name, tags and parameters of this request.
        dataset: makes the data set; None: it is drawn from its settings alone, which are in the
            key.
        domains: which head predicts an image.
        consistency: makes the views; None: the run measures none.
        tracking: the tracker.
    """

    folder: Path
    requested: Description
    dataset: Callable[[], LabelledDataset] | None
    domains: Domains
    consistency: Callable[[], ViewSets] | None
    tracking: Tracking


def show_known(config: DictConfig, overrides: list[str], extra_tags: Mapping[str, str]) -> bool:
    """Show the finished run that a configuration requests, if it was shown or trained before.

    Returns:
        False: the run is not finished, or its key is not noted (`rgbt.spec.request`).
    """
    if is_launched():
        return False
    known = known_run(config, tuple(overrides))
    if known is None:
        return False
    report_pretrained(known.plain["pretrained"], known.request.uses_pretrained, known.name)
    show(_of_known(known, extra_tags))
    return True


def is_launched() -> bool:
    """Whether this process is one of several that were started for one run."""
    return any(name in os.environ for name in LAUNCHED)


def report_pretrained(pretrained: str | None, is_used: bool, name: str) -> None:
    """Report that ``pretrained=...`` is ignored by an experiment."""
    if pretrained is not None and not is_used:
        info(
            f"pretrained={pretrained} is ignored: the experiment {name} does not use "
            "ImageNet weights."
        )


def finished_run(spec: RunSpec, extra_tags: Mapping[str, str] | None) -> FinishedRun:
    """The finished run of a specification."""
    return FinishedRun(
        folder=spec.folder,
        requested=describe(spec, extra_tags),
        dataset=spec.dataset.build if "root" in spec.dataset.plain else None,
        domains=spec.domains,
        consistency=spec.consistency.build if spec.consistency.plain["sets"] else None,
        tracking=spec.tracking.build(),
    )


def _of_known(known: KnownRun, extra_tags: Mapping[str, str]) -> FinishedRun:
    def node(key: str) -> Callable[[], Any]:
        return lambda: Component.from_node(known.config[key], key).build()

    return FinishedRun(
        folder=known.folder,
        requested=describe(known, extra_tags),
        dataset=node("dataset") if "root" in known.plain["dataset"] else None,
        domains=node("domains")(),
        consistency=node("consistency") if known.plain["consistency"]["sets"] else None,
        tracking=node("tracking")(),
    )


def show(run: FinishedRun) -> None:
    """Print the tables of a finished run, and what differs from the run that is requested now."""
    folder = RunFolder(run.folder)
    folder.clean()
    describe_again(folder, run.tracking, run.requested)
    warn_of_result(folder.path)
    _report_other_files(run, folder)
    _report_consistency(run, folder)
    print_result(folder, run.tracking, run.domains)


def print_result(folder: RunFolder, tracking: Tracking, domains: Domains) -> None:
    """Print the tables of a finished run, its folder and the addresses of its pages."""
    tables = read_tables(folder.path)
    assert tables is not None, "a finished run has its tables"
    heads = domains.heads_in_words(domains.tested_head)
    links = [*([("heads", heads)] if heads else []), *tracking.links()]
    print_rich(result_view(tables, folder.path, links))


def print_upstream_result(folder: RunFolder, name: str) -> None:
    """Print the scores and the folder of a finished upstream run in one line."""
    tables = read_tables(folder.path)
    assert tables is not None, "a finished run has its tables"
    values = {"mIoU": tables.regions.miou, **subset_mious(tables.classes)}
    found = ", ".join(f"{part} {percent(value)}" for part, value in values.items())
    print_rich(Text(f"upstream run {name}: {found}  {folder.path}"))


def describe_again(folder: RunFolder, tracking: Tracking, requested: Description) -> None:
    """Report that a run is finished; show it under the requested name if that says more."""
    known = read_description(folder.path)
    assert known is not None, "a finished run has its description"
    info(
        f"{requested.name} is already finished; its result follows. For a new run, choose "
        "another value of seed=..."
    )
    # A point of a grid may be the default of an experiment: the longer name says what it varies.
    lengths = [len(group_of(each.tags, each.params)) for each in (requested, known)]
    shown = requested if lengths[0] > lengths[1] else known
    merged = Description(shown.name, {**known.tags, **shown.tags}, known.params)
    tracking.refresh(folder, merged)


def _report_other_files(run: FinishedRun, folder: RunFolder) -> None:
    """Report a finished run of the same key that was made on another copy of the data set."""
    if run.dataset is None:
        return
    result = read_result(folder.path)
    try:
        now = run.dataset().fingerprint()
    except InputError:
        return  # a result can be shown without its data
    if result is not None and result["dataset"] != now:
        info(
            f"this run was trained on other files of the data set ({result['dataset'][:8]}, now "
            f"{now[:8]}). To train on the present files, set runs_dir=... or dataset.name=..."
        )


def _report_consistency(run: FinishedRun, folder: RunFolder) -> None:
    """Report a request for views on which the run was not measured."""
    if run.consistency is None:
        return
    from rgbt.metrics.pairs import file_name  # NumPy

    views = run.consistency()
    measured = [folder.path / file_name("aligned", each, views.mark) for each in views.splits]
    if not all(path.is_file() for path in measured):
        info(
            "the consistency of this run has not been measured on these views and splits. To "
            f"measure it: rgbt consistency run={folder.path} split=..."
        )
