"""Evaluations that tables request of finished runs."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal

from rgbt.metrics.details import OF_SCENES, DetailKind
from rgbt.metrics.pairs import Protocol, file_name
from rgbt.runs.naming import row_name
from rgbt.runs.result import RunResult

Head = Literal["as trained", "own", "source", "target"]
"""The head that predicts: that of the domain of each image, or that of one domain for all."""

BatchNorm = Literal["as trained", "recomputed", "adabn", "batch"]
"""Statistics of batch normalisation, see `rgbt.evaluation.request.BatchNormRequest`."""


@dataclass(frozen=True)
class ExtraEvaluation:
    """An evaluation of a finished run beside the one that every run ends with.

    Attributes:
        modality: "rgbt", "rgb" or "thermal"; "default": what the network is made for.
        regions: a file of ``conf/metric``, or "as trained".
        frames: protocol of pairs of frames, see `rgbt.metrics.pairs`; None: single frames.
        head: see `Head`; of single frames alone.
        corruption: of the images, NAME or NAME:IMAGE with a file of ``conf/corruption``; None:
            clean, as the evaluation that the run makes itself.
        severity: of the corruption; None: the only one that it has.
        batch_norm: see `BatchNorm`; of single frames alone.
        batch_norm_splits: splits whose images give its statistics; (): the evaluated one.
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
        """As shown: "thermal, ring9", "rgb, ring5, source head" or "consistency, aligned".

        Under a corruption: "default, ring5, occluded-0.5".
        """
        if self.frames is not None:
            return f"consistency, {self.frames}"
        head = [] if self.head == "as trained" else [f"{self.head} head"]
        details = [] if self.details is None else [self.details]
        world = [f"world {self.world}"] if self.world else []
        changes = [*head, *self._corrupted, *self._normalised, *details, *world]
        return ", ".join([self.modality, self.regions, *changes])

    @property
    def command(self) -> tuple[str, ...]:
        """Module that makes it, and its arguments except the run.

        One call makes both protocols of virtual views, aligned and released, and one call makes
        several details, because the network takes most of the time.
        """
        if self.frames is not None:
            return ("rgbt.consistency", f"frames={'next' if self.frames == 'next' else 'virtual'}")
        words = [f"modality={self.modality}", f"regions={self.regions}"]
        words += [] if self.head == "as trained" else [f"head={self.head}"]
        words += [] if self.corruption is None else [f"corruption={self.corruption}"]
        words += [] if self.severity is None else [f"severity={self.severity:g}"]
        words += [] if self.batch_norm == "as trained" else [f"batch_norm={self.batch_norm}"]
        if self.batch_norm_splits:
            words.append(f"batch_norm_splits={','.join(self.batch_norm_splits)}")
        if self.details is not None:
            words.append(
                f"details={'all' if self.details in OF_SCENES else 'boundary,calibration'}"
            )
        return ("rgbt.evaluate", *words, *self.dataset)

    @property
    def path(self) -> str:
        """Path of its counts inside the run folder, and among the run's files in MLflow."""
        return self.details_path(self.out)

    def details_path(self, out: str) -> str:
        """Path of its counts if the command writes `out`: details are beside the matrices."""
        return out if self.details is None else f"{out.removesuffix('.npz')}-{self.details}.npz"

    @property
    def out(self) -> str:
        """Path, inside the run folder, of the file that the command writes."""
        if self.frames is not None:
            return file_name(self.frames, "test")
        head = [] if self.head == "as trained" else [f"{self.head}-head"]
        regions = self.regions.replace(" ", "-")
        # By the overrides and not by the name, whose overrides may change.
        digest = hashlib.sha256("\n".join(self.dataset).encode()).hexdigest()[:8]
        world = [f"world-{digest}"] if self.dataset else []
        changes = [*head, *self._corrupted, *self._normalised, *world]
        name = "_".join(["table", self.modality, regions, *changes])
        return f"evaluations/{name}.npz"

    @property
    def _corrupted(self) -> list[str]:
        """The corruption with its severity, as part of a name; [] without one."""
        severity = "" if self.severity is None else f"-{self.severity:g}"
        return [f"{row_name(self.corruption)}{severity}"] if self.corruption else []

    @property
    def _normalised(self) -> list[str]:
        """The statistics of batch normalisation, as part of a name; [] as trained."""
        if self.batch_norm == "as trained":
            return []
        return ["-".join(("norm", self.batch_norm, *self.batch_norm_splits))]
