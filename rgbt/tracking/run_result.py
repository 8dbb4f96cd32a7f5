"""Read a finished run from its folder; rgbt, sweeps and analysis all use this type.

`rgbt.tracking.run_folder.RunFolder` writes the folder of a run in progress.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.names import in_percent
from rgbt.tracking.other_code import other_code
from rgbt.tracking.provenance import commit_of
from rgbt.tracking.run_files import (
    ADVICE,
    Description,
    counts_name,
    read_description,
    read_provenance,
    read_result,
)

CHECKPOINT = "best.pt"
"""The checkpoint of evaluations, which is not copied to other machines."""

ALL_COUNTS = "counts_*.npz"
"""Pattern of the files of counts that a run ended with."""


@dataclass(frozen=True)
class RunResult:
    """The results of a finished run. Every property reads its file again.

    Attributes:
        folder: the run folder, or a folder with copies of its files.
        run_id: of the MLflow run that the copies come from, else "".
    """

    folder: Path
    run_id: str = ""

    @property
    def key(self) -> str:
        """Config key of the run."""
        return self.folder.name

    @property
    def is_finished(self) -> bool:
        """Whether the run has its result; InputError where that is damaged."""
        return read_result(self.folder) is not None

    @property
    def result(self) -> dict[str, Any]:
        """``result.json`` (`rgbt.training.train`).

        Raises:
            InputError: it is missing, damaged, or names no data set.
        """
        result = read_result(self.folder)
        if result is None or "dataset" not in result:
            raise InputError(
                f"{self.folder / 'result.json'} is missing or names no data set; {ADVICE}."
            )
        return result

    @property
    def dataset(self) -> str:
        """Fingerprint of the data set that the run was made on."""
        return str(self.result["dataset"])

    @property
    def description(self) -> Description:
        """Name, tags and parameters; empty where the folder has no ``run.json``."""
        return read_description(self.folder) or Description("", {}, {})

    @property
    def tags(self) -> dict[str, str]:
        """Tags by name."""
        return self.description.tags

    @property
    def provenance(self) -> list[dict[str, Any]]:
        """Entries of all processes that worked on the run, first one first."""
        return read_provenance(self.folder / "provenance.json")

    @property
    def commit(self) -> str | None:
        """Git commit of the code that made it; "+" is added for changes that were not committed."""
        return commit_of(next(iter(self.provenance), {})) or None

    @property
    def other_code(self) -> str | None:
        """The code that made it, in words, where it is not that of this process; else None."""
        return other_code(self.folder)

    def scores(self) -> dict[str, float]:
        """Scores by "val/..." and "test/..." names, as MLflow shows them but not rounded."""
        result = self.result
        return {
            f"{split}/{name}": in_percent(name, value)
            for split in ("val", "test")
            for name, value in result.get(split, {}).items()
            if value is not None
        }

    def counts_path(self, split: str = "test") -> Path:
        """Path of the counts of the run's final evaluation."""
        return self.folder / counts_name(split)

    def counts(self, path: str = "counts_test.npz") -> Counts:
        """Counts of an evaluation.

        Args:
            path: of the file, relative to the run folder; default: the run's final evaluation.

        Raises:
            InputError: the file is missing or damaged.
        """
        return Counts.load(self.folder / path)

    def counts_of(self, split: str) -> Counts:
        """Counts of a split, which the run ended with or which were written beside them.

        Raises:
            InputError: the folder has no counts of the split, or the file is damaged.
        """
        path = self.counts_path(split)
        if path.is_file():
            return Counts.load(path)
        there = sorted(each.stem.removeprefix("counts_") for each in path.parent.glob(ALL_COUNTS))
        how = "rerun the command of the run to finish it"
        if self.is_finished:
            how = f"write them with: rgbt evaluate run={self.folder} split={split} out={path}"
        raise InputError(
            f"{self.folder} has counts of the splits {', '.join(there) or 'none'}, but not of "
            f"'{split}'; {how}."
        )

    def has_counts(self, path: str, *, other_dataset: bool = False) -> bool:
        """Whether `path` holds counts of the test split that this training made.

        Args:
            path: of the file, relative to the run folder.
            other_dataset: whether they may be of another data set than the run's own.
        """
        # Compared with the checkpoint: a run may write an evaluation before its result.
        file, best = self.folder / path, self.folder / CHECKPOINT
        if not file.exists() or (best.exists() and file.stat().st_mtime < best.stat().st_mtime):
            return False
        try:
            counts = Counts.load(file)
        except InputError:  # not readable: the evaluation is repeated
            return False
        is_own = counts.dataset == self.dataset
        return (is_own or other_dataset) and counts.split == "test"
