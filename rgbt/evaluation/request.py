"""The requests for an evaluation: a trained network, and what to evaluate."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from rgbt.build.load_run import TrainedNetwork, open_exported, open_trained
from rgbt.checks import InputError, check_choice, split_list
from rgbt.config.common_options import AS_TRAINED, NetworkOptions
from rgbt.config.stored_config import parse_trust
from rgbt.corruptions.corruption import OfTime
from rgbt.data.domains import TestedHead
from rgbt.data.label_map import LabelMap
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.corruption_request import CorruptionRequest
from rgbt.metrics.details import Details
from rgbt.types import VIEWS, View

DEFAULT_VIEW = "default"
BEST = "best"
"""Default values of the options `modality` and `checkpoint`."""

CHANGES = ("transform", "trainer.precision", "metric", "prediction")
"""Settings that change the counts or scores of the same run."""


@dataclass(frozen=True)
class NetworkRequest:
    """A trained network with overrides of its configuration.

    Attributes:
        options: of the command.
        overrides: of the configuration of the run, or of a network with `model.weights`.
        regions: a file of ``conf/metric``, or `AS_TRAINED`.
    """

    options: NetworkOptions
    overrides: Sequence[str]
    regions: str = AS_TRAINED

    @property
    def suffixes(self) -> tuple[str, ...]:
        """The checkpoint in file names; nothing for the best."""
        return () if self.options.checkpoint == BEST else (self.options.checkpoint,)

    @property
    def trust(self) -> tuple[str, ...]:
        """Modules that the configuration may name (`rgbt.config.stored_config`)."""
        return parse_trust(self.options.trust)

    def check_comparable(self, out: Path | None) -> None:
        """Refuse to store counts with other settings beside those of the run.

        Raises:
            InputError: an override of `CHANGES`, and no folder of its own in `out`.
        """
        changed = [word for word in self.overrides if word.lstrip("+").startswith(CHANGES)]
        if changed and self.options.run and not out:
            raise InputError(
                f"{changed[0]} changes how the run is measured; choose a separate folder for "
                "these counts with out=..."
            )

    def open(self, label_map: LabelMap | None = None) -> TrainedNetwork:
        """The network with its weights: of a run, of a file of weights, or an exported one.

        Raises:
            InputError: as `open_trained` or `open_exported`; or both are named.
        """
        options = self.options
        regions = [] if self.regions == AS_TRAINED else [f"metric={self.regions}"]
        words = [*self.overrides, *regions]
        if options.exported is None:
            return open_trained(
                options.run, options.runs_dir, words, options.checkpoint, label_map, self.trust
            )
        if options.run or options.checkpoint != BEST:
            raise InputError(
                "exported= is a network with its weights; omit run= and checkpoint=, or omit "
                "exported=."
            )
        return open_exported(options.exported, options.runs_dir, words, label_map, self.trust)


def other_images(dataset: LabelledDataset, marker: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Part of a file name if a run is measured on another data set than it was trained on.

    `marker` is its ``dataset.json``; None: it has none.
    """
    trained_on = (marker or {}).get("files")
    if trained_on in (None, found := dataset.fingerprint()):
        return ()
    return (f"{dataset.name}-{found[:8]}",)


Statistics = Literal["recomputed", "adabn", "batch"]


@dataclass(frozen=True, kw_only=True)
class BatchNormRequest:
    """Statistics of batch normalisation that replace those of the training; no label is read.

    Attributes:
        kind: "recomputed": mean and variance over all images; "adabn": those of the images by day
            for images by day, and those of the night for the night; "batch": those of each batch,
            whose images are all by day or all of the night.
        splits: whose images they are computed from; (): the evaluated split.
    """

    kind: Statistics
    splits: tuple[str, ...] = ()

    @classmethod
    def from_options(cls, kind: str, splits: str) -> BatchNormRequest | None:
        """Make a request from the options of a command; None for "as trained".

        Raises:
            InputError: splits that have no effect.
        """
        if splits and kind in (AS_TRAINED, "batch"):
            raise InputError(
                f"batch_norm_splits={splits} has no effect with batch_norm={kind}; set "
                "batch_norm=adabn or batch_norm=recomputed, or omit it."
            )
        if kind == AS_TRAINED:
            return None
        named = dict.fromkeys(split_list(splits, "batch_norm_splits") if splits else ())
        return cls(kind=cast(Statistics, kind), splits=tuple(named))

    @property
    def file_stem(self) -> str:
        """For file names: "norm-adabn", "norm-adabn-train_day-train_night"."""
        return "-".join(("norm", self.kind, *self.splits))

    @property
    def title(self) -> str:
        """For people: "AdaBN"."""
        titles = {
            "recomputed": "recomputed statistics",
            "adabn": "AdaBN",
            "batch": "statistics of the batch",
        }
        return titles[self.kind]


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """One evaluation of a network: segmentation, consistency, corrupted images or pseudo-labels.

    Attributes:
        split: name of the split.
        view: input images; None: those that the network was designed for.
        head: which of two heads predicts an image; None: that of the run's configuration.
        corruption: of the images; None: they are clean.
        keep: names of the images that are returned for pictures.
        details: what else is counted, see `rgbt.metrics.details`.
        batch_norm: statistics of batch normalisation; None: those of the training.

    Raises:
        InputError: statistics of other splits under a corruption of time.
    """

    split: str
    view: View | None = None
    head: TestedHead | None = None
    corruption: CorruptionRequest | None = None
    keep: Collection[str] = ()
    details: tuple[Details, ...] = ()
    batch_norm: BatchNormRequest | None = None

    def __post_init__(self) -> None:
        splits = () if self.batch_norm is None else self.batch_norm.splits
        corruption = self.corruption
        if corruption is None or not isinstance(corruption.corruption, OfTime):
            return
        if set(splits) - {self.split}:
            raise InputError(
                f"batch_norm_splits={','.join(splits)} cannot be used with "
                f"corruption={corruption.name}, which shows earlier frames of '{self.split}'; "
                "omit batch_norm_splits, or choose another corruption."
            )

    @classmethod
    def from_options(
        cls,
        split: str,
        modality: str,
        head: str = AS_TRAINED,
        corruption: CorruptionRequest | None = None,
        details: tuple[Details, ...] = (),
    ) -> EvaluationRequest:
        """Make a request from the options of a command.

        Raises:
            InputError: there is no such modality.
        """
        check_choice("modality", modality, (DEFAULT_VIEW, *VIEWS))
        return cls(
            split=split,
            view=None if modality == DEFAULT_VIEW else cast(View, modality),
            head=None if head == AS_TRAINED else cast(TestedHead, head),
            corruption=corruption,
            details=details,
        )
