"""Read a finished run from its folder; rgbt, sweeps and analysis all use this type."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.config.stored_config import read_settings
from rgbt.files.plain_files import check_links
from rgbt.metrics.counts import Counts
from rgbt.metrics.names import in_percent
from rgbt.runs.folder import (
    ADVICE,
    Description,
    counts_name,
    is_finished,
    read_description,
    read_provenance,
    read_result,
)
from rgbt.runs.provenance import commit_of, machine_name, other_code

# The checkpoint of evaluations, and the pattern of the counts that a run ended with.
CHECKPOINT, ALL_COUNTS = "best.pt", "counts_*.npz"


@dataclass(frozen=True)
class RunResult:
    """The results of a finished run. Every property reads its file again.

    Attributes:
        folder: the run folder, or a folder with copies of its files.
        run_id: of the MLflow run that the copies come from, else "".

    Raises:
        InputError: the folder holds a link that leads out of it. Every property: a damaged file.
    """

    folder: Path
    run_id: str = ""

    def __post_init__(self) -> None:
        check_links(self.folder)

    @property
    def key(self) -> str:
        """Config key of the run, the name of its folder."""
        return self.folder.name

    @property
    def is_finished(self) -> bool:
        """Whether the run has its result."""
        return is_finished(self.folder)

    @property
    def result(self) -> dict[str, Any]:
        """``result.json`` (`rgbt.training.train`); InputError where it names no data set."""
        result, path = read_result(self.folder), self.folder / "result.json"
        if result is None or "dataset" not in result:
            raise InputError(f"{path} is missing or names no data set; {ADVICE}.")
        return result

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the data set that the run was made on."""
        return str(self.result["dataset"])

    @property
    def settings(self) -> dict[str, Any]:
        """Plain values of its configuration, from which nothing is built."""
        return read_settings(self.folder / "config.yaml")

    @property
    def description(self) -> Description:
        """Name, tags and parameters; empty where the folder has no ``run.json``."""
        return read_description(self.folder) or Description("", {}, {})

    @property
    def tags(self) -> dict[str, str]:
        """Tags by name."""
        return self.description.tags

    @property
    def lists(self) -> str:
        """Which lists it was trained and selected on, in words; "" without ``run.json``."""
        return self.tags.get("rgbt.lists", "")

    @property
    def machine(self) -> str:
        """Graphics card of the process that began it, else its processor; "" where not recorded."""
        return machine_name((self.provenance or [{}])[0])

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

    def recorded_scores(self) -> dict[str, float]:
        """Scores by "val/..." and "test/..." names, as MLflow shows them but not rounded."""
        result = self.result
        return {
            f"{split}/{name}": in_percent(name, value)
            for split in ("val", "test")
            for name, value in result.get(split, {}).items()
            if value is not None
        }

    def counts(self, split: str = "test") -> Counts:
        """The stored confusion counts of a split, per image and region.

        Args:
            split: "test" and the split that chose the checkpoint (usually "val") are always there;
                ``rgbt evaluate run=... split=... out=RUN_FOLDER/counts_SPLIT.npz`` adds others.
                Or a file of the run folder: "evaluations/test_rgb.npz".

        Raises:
            InputError: the run has no such counts, or the file is damaged.
        """
        path = self.folder / (split if split.endswith(".npz") else counts_name(split))
        if path.is_file() or split.endswith(".npz"):
            counts = Counts.load(path)
            if counts.run not in ("", self.key) and not self.run_id:
                raise InputError(
                    f"{path} has counts of the run {counts.run}, not of {self.key}; restore the "
                    "file of this run, or give its folder the name of the run."
                )
            return counts
        how = "rerun the command of the run to finish it"
        if self.is_finished:
            how = f"write them with: rgbt evaluate run={self.folder} split={split} out={path}"
        raise InputError(f"{self.folder} has no counts of the split '{split}'; {how}.")

    def has_counts(self, path: str, *, other_dataset: bool = False) -> bool:
        """Whether the file `path` of the folder holds test counts that this training made.

        With `other_dataset` they may be of another data set than the run's own.
        """
        # Compared with the checkpoint: a run may write an evaluation before its result.
        file, best = self.folder / path, self.folder / CHECKPOINT
        if not file.exists() or (best.exists() and file.stat().st_mtime < best.stat().st_mtime):
            return False
        try:
            counts = Counts.load(file)
        except InputError:  # not readable: the evaluation is repeated
            return False
        return counts.split == "test" and (other_dataset or counts.dataset == self.fingerprint)
