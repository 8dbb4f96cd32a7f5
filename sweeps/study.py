"""Report of a study: ``rgbt study name=search/grbm``, also while it runs.

Tables in the terminal; ``runs/studies/<name>/`` gets them as Markdown and CSV.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt study``."""

    name: Annotated[str, Help("name of the study; without a name, all studies are listed")] = ""
    storage: Annotated[str, Help("sqlite:///FILE or postgresql://...; default: studies.db")] = ""
    runs_dir: RunsDir = Path("runs")
    out: Annotated[Path | None, Help("folder of the report; default: studies/<name>")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Show the results of a study: best trials, failures, importances."""
    del overrides  # none is heeded
    from sweeps.report.study import publish_study, study_folder
    from sweeps.worker.storage import load_study, open_storage, storage_file, storage_url

    runs_dir = options.runs_dir
    url = storage_url(options.storage, runs_dir)
    file = storage_file(url)
    if file is not None and not file.is_file():  # opening it would create an empty one
        raise InputError(f"there is no storage {file}; give runs_dir=... or storage=...")
    storage = open_storage(url, runs_dir)
    study = load_study(options.name, storage)
    out = options.out or study_folder(runs_dir, study.study_name)
    publish_study(study, out, url)
    return 0


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
