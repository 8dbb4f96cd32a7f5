"""Report of a study: ``rgbt study name=search/grbm``, also while it runs.

Tables in the terminal; ``runs/studies/<name>/`` gets them as Markdown and CSV with the figures, and
MLflow a run that holds these files.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rgbt.checks import InputError
from rgbt.config.command import built
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help, readable_paths
from rgbt.config.plain_command import PlainCommand
from rgbt.runs.provenance import without_passwords
from sweeps.worker.storage import JOURNAL, load_study, open_storage, storage_file, study_names

if TYPE_CHECKING:
    import optuna

    from rgbt.tables import TextTable
    from rgbt.tracking.tracker import Link, Tracking
    from sweeps.report.figures import StudyFigure
    from sweeps.report.study_data import Importances, StudyData


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt study``."""

    name: Annotated[str, Help("name of the study; without a name, all studies are listed")] = ""
    storage: Annotated[
        str,
        Help(
            "Optuna storage: file.journal, sqlite:///FILE or postgresql://USER@HOST/NAME; default: "
            "studies.journal in the folder of runs"
        ),
    ] = ""
    runs_dir: RunsDir = Path("runs")
    out: Annotated[
        Path | None,
        Help(
            "output folder of Markdown, CSV and PNG files; default: studies/<name> in the folder "
            "of runs"
        ),
    ] = None


NAME_LENGTH = 80
"""Characters of a folder name; longer names are cut and get a hash."""


def main(options: Options, overrides: list[str]) -> int:
    """Show the results of a study: best trials, failures, importances, figures.

    Overrides choose the tracker: tracking=none or tracking.uri=http://host:5000
    """
    runs_dir = options.runs_dir
    place = options.storage or None
    _check_exists(place, runs_dir)
    storage = open_storage(place, runs_dir)
    if not options.name:
        known = ", ".join(study_names(storage)) or "none"
        raise InputError(f"choose a study with name=...; the storage has: {known}.")
    study = load_study(options.name, storage)
    tracking = built("tracking", [*readable_paths([f"runs_dir={runs_dir}"]), *overrides])
    out = options.out or study_folder(runs_dir, study.study_name)
    links = report(study, out, tracking)
    show_links([*links, ("dashboard", dashboard_command(place, runs_dir))])
    return 0


def report(study: optuna.Study, out: Path, tracking: Tracking) -> list[Link]:
    """Print the tables of a study, write its files into `out` and send them to the tracker.

    Returns:
        links to everything, as (name, address).
    """
    from rich.console import Group
    from rich.text import Text

    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import print_rich, rich_table
    from sweeps.report.figures import draw
    from sweeps.report.records import record
    from sweeps.report.study_data import importances, read
    from sweeps.report.tables import tables, trials_csv

    data = read(study)
    shares = importances(data)
    grids = tables(data, shares)
    out.mkdir(parents=True, exist_ok=True)
    pictures = draw(data, shares, out)
    lines = remarks(shares, pictures)
    text = markdown(data, grids, lines)
    write_atomic(out / "study.md", (text + gallery(pictures)).encode())
    write_atomic(out / "trials.csv", trials_csv(data).encode())
    print_rich(Group(*map(rich_table, grids), Text("\n".join(lines))))
    drawn = [picture.path for picture in pictures if picture.path is not None]
    links = record(
        tracking,
        # A table and its study may have one name, and are two records.
        name=f"study {data.name}",
        kind="study",
        files=[out / "study.md", out / "trials.csv", *drawn],
        metrics=metrics(data),
        tags={"rgbt.study": data.name, "rgbt.study.kind": data.kind},
        note=text,
    )
    return [("report", str(out / "study.md")), ("figures", f"{len(drawn)} in {out}"), *links]


def markdown(data: StudyData, grids: Sequence[TextTable], remark_lines: Sequence[str]) -> str:
    """The report in Markdown, without figures: MLflow's descriptions cannot show them."""
    from sweeps.report.tables import markdown_table

    way = ["highest" if up else "lowest" for up in data.maximize]
    objectives = ", ".join(f"{w} {metric}" for w, metric in zip(way, data.metrics, strict=True))
    created = f"Created by `{without_passwords(data.command)}`.\n" if data.command else ""
    head = f"# Study {data.name}\n\nKind: {data.kind}. Objectives: {objectives}.\n{created}"
    remarked = "".join(f"- {line}\n" for line in remark_lines)
    return "\n".join([head, *map(markdown_table, grids), remarked])


def gallery(pictures: Sequence[StudyFigure]) -> str:
    """The figures in Markdown, by the names of their files."""
    drawn = [picture for picture in pictures if picture.path is not None]
    return "".join(f"\n## {p.title}\n\n![{p.title}]({p.name}.png)\n" for p in drawn)


def remarks(shares: Importances, pictures: Sequence[StudyFigure]) -> list[str]:
    """Remarks below the tables: on the importances, and why figures are missing."""
    missing: dict[str, list[str]] = {}
    for picture in pictures:
        if picture.path is None:
            missing.setdefault(picture.reason, []).append(picture.name)
    lines = [f"No figure {', '.join(names)}: {reason}" for reason, names in missing.items()]
    is_said = shares.remark in missing
    return [*([f"Importances: {shares.remark}"] if shares.remark and not is_said else []), *lines]


def metrics(data: StudyData) -> dict[str, float]:
    """Metrics of a study in MLflow: the best of each objective, trials by state, steps saved."""
    from sweeps.report.study_data import pruning_savings
    from sweeps.report.tables import WORDS

    numbers = {f"trials/{WORDS[state]}": float(count) for state, count in data.counts().items()}
    for index, metric in enumerate(data.metrics):
        values = [trial.values[index] for trial in data.complete]
        if values:
            numbers[f"best/{metric}"] = max(values) if data.maximize[index] else min(values)
    saved = pruning_savings(data)
    if saved is not None:
        numbers["steps_saved"] = 100.0 * saved.share
    return numbers


def study_folder(runs_dir: Path, name: str) -> Path:
    """Folder of the report of a study; characters such as / in its name are replaced."""
    safe = re.sub(r"[^\w+=.-]+", "_", name).lstrip(".")[:NAME_LENGTH]
    if safe != name:
        safe += "-" + hashlib.sha256(name.encode()).hexdigest()[:6]
    return runs_dir / "studies" / safe


def dashboard_command(storage: str | None, runs_dir: Path) -> str:
    """The command that opens optuna-dashboard on a storage, passwords hidden."""
    return f"optuna-dashboard {without_passwords(storage or str(runs_dir / JOURNAL))}"


def _check_exists(storage: str | None, runs_dir: Path) -> None:
    """Refuse a missing file: opening it would create an empty one."""
    file = storage_file(storage or str(runs_dir / JOURNAL))
    if file is not None and not file.is_file():
        raise InputError(
            f"there is no storage {file}; give the folder of runs with runs_dir=... or the "
            "storage with storage=..."
        )


def show_links(links: Sequence[Link]) -> None:
    """Print links, one "name  address" pair per line."""
    from rgbt.terminal import path_lines, print_rich

    print_rich(path_lines(links))


entry = PlainCommand(Options, main, heeds=("tracking",))

if __name__ == "__main__":
    entry()
