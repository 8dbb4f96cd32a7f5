"""Evaluations that tables request of finished runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rgbt.metrics.pairs import Protocol, file_name
from rgbt.spec.corruption_names import row_name

Head = Literal["as trained", "own", "source", "target"]
"""Which head of a network predicts: that of an image's own domain, or one domain's for all."""


@dataclass(frozen=True)
class ExtraEvaluation:
    """An evaluation of a finished run beside the one that every run ends with.

    Attributes:
        modality: "rgbt", "rgb" or "thermal"; "default": what the network is made for.
        regions: a file of ``conf/metric``, or "as trained".
        frames: protocol of pairs of frames, see `rgbt.metrics.pairs`; None: single frames.
        head: see `Head`; of single frames alone.
        corruption: of the images, NAME or NAME:IMAGE with a file of ``conf/corruption``; None:
            clean, as the run's own.
        severity: of the corruption; None: the only one that it has.
    """

    modality: str = "default"
    regions: str = "as trained"
    frames: Protocol | None = None
    head: Head = "as trained"
    corruption: str | None = None
    severity: float | None = None

    @property
    def label(self) -> str:
        """As shown: "thermal, ring9", "rgb, ring5, source head" or "consistency, aligned".

        Under a corruption: "default, ring5, occluded-0.5".
        """
        if self.frames is not None:
            return f"consistency, {self.frames}"
        head = "" if self.head == "as trained" else f", {self.head} head"
        corrupted = f", {self._corrupted}" if self.corruption else ""
        return f"{self.modality}, {self.regions}{head}{corrupted}"

    @property
    def command(self) -> tuple[str, ...]:
        """Module that makes it, and its arguments except the run.

        One call makes both protocols of virtual views, aligned and released.
        """
        if self.frames is not None:
            return ("rgbt.consistency", f"frames={'next' if self.frames == 'next' else 'virtual'}")
        head = () if self.head == "as trained" else (f"head={self.head}",)
        corruption = () if self.corruption is None else (f"corruption={self.corruption}",)
        severity = () if self.severity is None else (f"severity={self.severity:g}",)
        arguments = (f"modality={self.modality}", f"regions={self.regions}")
        return ("rgbt.evaluate", *arguments, *head, *corruption, *severity)

    @property
    def path(self) -> str:
        """Path of its counts inside the run folder, and among the run's files in MLflow."""
        if self.frames is not None:
            return file_name(self.frames, "test")
        head = "" if self.head == "as trained" else f"_{self.head}-head"
        corrupted = f"_{self._corrupted}" if self.corruption else ""
        regions = self.regions.replace(" ", "-")
        return f"evaluations/table_{self.modality}_{regions}{head}{corrupted}.npz"

    @property
    def _corrupted(self) -> str:
        """The corruption with its severity, as part of a name."""
        severity = "" if self.severity is None else f"-{self.severity:g}"
        return f"{row_name(self.corruption or '')}{severity}"
