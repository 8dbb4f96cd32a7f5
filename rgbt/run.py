"""Train one configuration: ``python -m rgbt.run +experiment=grbm``.

The same command resumes an unfinished run; for a finished run it prints the tables.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.config.command import command
from rgbt.config.overrides import words_of_run
from rgbt.files.atomic import check_writable

if TYPE_CHECKING:
    from omegaconf import DictConfig


@command(sweeper="study")
def main(config: DictConfig, overrides: list[str]) -> int:
    """Train the upstream runs and the run, evaluate its checkpoint on the test split.

    With -m, a grid (key=1,2) or a search. The same command resumes an unfinished run.
    """
    from rgbt.runs.naming import tags_from_environment
    from rgbt.runs.specify import requested_run
    from rgbt.runtime.group import group_from_environment
    from rgbt.terminal import info

    tags = tags_from_environment()
    run = requested_run(config, overrides)
    file, out = run.plain["pretrained"], run.plain["out"]
    if file is not None and not run.uses_pretrained:
        info(f"pretrained={file} is ignored: {run.name} does not use ImageNet weights.")
    if out is not None:
        raise InputError(f"out={out} has no effect here: runs are written to runs_dir=...")
    if run.is_finished and not run.fresh:
        from rgbt.training.report import show

        group = group_from_environment()
        if group is None or group.rank == 0:
            show(run, tags)
        return 0
    folder = run.folder.parent
    check_writable(f"runs_dir={folder}", folder)
    from rgbt.training.pipeline import start

    # torch is imported from here on, after --help and after finished runs
    return start(run.check(), tags, words_of_run(overrides))


if __name__ == "__main__":
    main()
