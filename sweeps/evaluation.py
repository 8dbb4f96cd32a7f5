"""Evaluations that tables request of finished runs."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal

from rgbt.metrics.details import SCENE_KINDS, DetailKind
from rgbt.metrics.pairs import Protocol, file_name
from rgbt.runs.naming import row_name
from rgbt.runs.result import RunResult

# The head that predicts: that of the domain of each image, or that of one domain for all.
Head = Literal["as trained", "own", "source", "target"]

# Statistics of batch normalisation, see `rgbt.evaluation.request.BatchNormRequest`.
BatchNorm = Literal["as trained", "recomputed", "adabn", "batch"]


@dataclass(frozen=True)
class ExtraEvaluation:
    """An evaluation of a finished run beside the one that every run ends with.

    Attributes: see `sweeps.table.table.Column`, and
        regions: a file of ``conf/metric``, or "as trained".
        details: kind of counts beside the confusion matrices, see `rgbt.metrics.details`.
        world: name of the images where they are not the run's own, e.g. "O-N+"; "" where they are.
        dataset: overrides of the data set that make this world.
    """

    modality: str = "default"
    regions: str = "as trained"
    frames: Protocol | None = None
    head: Head = "as trained"
    corruption: str | None = None
    severity: float | None = None
    batch_norm: BatchNorm = "as trained"
    batch_norm_splits: tuple[str, ...] = ()
    details: DetailKind | None = None
    world: str = ""
    dataset: tuple[str, ...] = ()

    def is_stored(self, result: RunResult) -> bool:
        """Whether a finished run has its counts."""
        return result.has_counts(self.path, other_dataset=bool(self.dataset))

    @property
    def label(self) -> str:
        """The name of its counts: "table_rgb_ring5_occluded-0.5"."""
        return self.path.rpartition("/")[2].removesuffix(".npz")

    @property
    def command(self) -> tuple[str, ...]:
        """Module that makes it, and its arguments except the run.

        One call makes both protocols of virtual views, or several details.
        """
        if self.frames is not None:
            return ("rgbt.consistency", f"frames={'next' if self.frames == 'next' else 'virtual'}")
        details = "all" if self.details in SCENE_KINDS else "boundary,calibration"
        given = {
            "head": None if self.head == "as trained" else self.head,
            "corruption": self.corruption,
            "severity": None if self.severity is None else f"{self.severity:g}",
            "batch_norm": None if self.batch_norm == "as trained" else self.batch_norm,
            "batch_norm_splits": ",".join(self.batch_norm_splits) or None,
            "details": None if self.details is None else details,
        }
        words = (f"{key}={value}" for key, value in given.items() if value is not None)
        fixed = (f"modality={self.modality}", f"regions={self.regions}")
        return ("rgbt.evaluate", *fixed, *words, *self.dataset)

    @property
    def path(self) -> str:
        """Path of its counts inside the run folder: details are beside the matrices."""
        out = self.out
        return out if self.details is None else f"{out.removesuffix('.npz')}-{self.details}.npz"

    @property
    def out(self) -> str:
        """Path, inside the run folder, of the file that the command writes."""
        if self.frames is not None:
            return file_name(self.frames, "test")
        head = "" if self.head == "as trained" else f"{self.head}-head"
        # The overrides tell worlds apart, because those of a name may change.
        digest = hashlib.sha256("\n".join(self.dataset).encode()).hexdigest()[:8]
        world = f"world-{digest}" if self.dataset else ""
        severity = "" if self.severity is None else f"-{self.severity:g}"
        corruption = f"{row_name(self.corruption)}{severity}" if self.corruption else ""
        norm = "-".join(("norm", self.batch_norm, *self.batch_norm_splits))
        norm = "" if self.batch_norm == "as trained" else norm
        regions = self.regions.replace(" ", "-")
        words = ("table", self.modality, regions, head, corruption, norm, world)
        return f"evaluations/{'_'.join(filter(None, words))}.npz"
