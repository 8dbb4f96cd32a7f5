"""Evaluations that tables request of finished runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rgbt.metrics.pairs import Protocol, file_name

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
        degradation: of the images, a file of ``conf/degradation``; None: clean, as the run's own.
        severity: of the degradation; None: the only one that it has.
    """

    modality: str = "default"
    regions: str = "as trained"
    frames: Protocol | None = None
    head: Head = "as trained"
    degradation: str | None = None
    severity: float | None = None

    @property
    def label(self) -> str:
        """For people: "thermal, ring9", "rgb, ring5, source head" or "consistency, aligned".

        Under a degradation: "default, ring5, occluded-0.5".
        """
        if self.frames is not None:
            return f"consistency, {self.frames}"
        head = "" if self.head == "as trained" else f", {self.head} head"
        failing = f", {self._failing}" if self.degradation else ""
        return f"{self.modality}, {self.regions}{head}{failing}"

    @property
    def command(self) -> tuple[str, ...]:
        """Module that makes it and what it is asked, beside the run.

        One call makes both protocols of virtual views, aligned and released.
        """
        if self.frames is not None:
            return ("rgbt.consistency", f"frames={'next' if self.frames == 'next' else 'virtual'}")
        head = () if self.head == "as trained" else (f"head={self.head}",)
        failing = () if self.degradation is None else (f"degradation={self.degradation}",)
        severity = () if self.severity is None else (f"severity={self.severity:g}",)
        asked = (f"modality={self.modality}", f"regions={self.regions}")
        return ("rgbt.evaluate", *asked, *head, *failing, *severity)

    @property
    def path(self) -> str:
        """Path of its counts inside the run folder, and among the run's files in MLflow."""
        if self.frames is not None:
            return file_name(self.frames, "test")
        head = "" if self.head == "as trained" else f"_{self.head}-head"
        failing = f"_{self._failing}" if self.degradation else ""
        regions = self.regions.replace(" ", "-")
        return f"evaluations/table_{self.modality}_{regions}{head}{failing}.npz"

    @property
    def _failing(self) -> str:
        """The degradation with its severity, as part of a name."""
        return f"{self.degradation}" + ("" if self.severity is None else f"-{self.severity:g}")
