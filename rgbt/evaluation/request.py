"""What is evaluated: a trained network, and the request that every kind of evaluation takes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from rgbt.build.load_run import TrainedNetwork, open_trained
from rgbt.checks import InputError, check_choice
from rgbt.config.common_options import AS_TRAINED, NetworkOptions
from rgbt.config.stored_config import parse_trust
from rgbt.data.domains import TestedHead
from rgbt.data.label_map import LabelMap
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.corruption_request import CorruptionRequest
from rgbt.types import VIEWS, View

DEFAULT_VIEW = "default"
BEST = "best"
"""Values of the options `modality` and `checkpoint` that change nothing."""

CHANGES = ("transform", "trainer.precision", "metric")
"""Settings by which the same run gives other counts, or other scores of them."""


@dataclass(frozen=True)
class NetworkRequest:
    """Which trained network is evaluated, and what is changed of its configuration.

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
        """What names of files say of the checkpoint: nothing of the best."""
        return () if self.options.checkpoint == BEST else (self.options.checkpoint,)

    @property
    def trust(self) -> tuple[str, ...]:
        """Modules that the configuration may name (`rgbt.config.stored_config`)."""
        return parse_trust(self.options.trust)

    def check_comparable(self, out: Path | None) -> None:
        """Refuse to keep counts made in another way among those of the run.

        Raises:
            InputError: an override of `CHANGES`, and no folder of its own in `out`.
        """
        changed = [word for word in self.overrides if word.lstrip("+").startswith(CHANGES)]
        if changed and self.options.run and not out:
            raise InputError(
                f"{changed[0]} changes how the run is measured; name a folder for these counts "
                "with out=..."
            )

    def open(self, label_map: LabelMap | None = None) -> TrainedNetwork:
        """The network with its weights (`rgbt.build.load_run.open_trained`)."""
        regions = [] if self.regions == AS_TRAINED else [f"metric={self.regions}"]
        return open_trained(
            self.options.run,
            self.options.runs_dir,
            [*self.overrides, *regions],
            self.options.checkpoint,
            label_map,
            self.trust,
        )


def other_images(dataset: LabelledDataset, marker: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Part of a file's name where a run is measured on images that it was not trained with.

    `marker` is its ``dataset.json``; None: it has none.
    """
    trained_on = (marker or {}).get("files")
    if trained_on in (None, found := dataset.fingerprint()):
        return ()
    return (f"{dataset.name}-{found[:8]}",)


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """One evaluation of a network: segmentation, consistency, corrupted images or pseudo-labels.

    Attributes:
        split: name of the split.
        view: what is predicted from; None: what the network is made for.
        head: which of two heads predicts an image; None: as the run's configuration says.
        corruption: of the images; None: they are clean.
        keep: names of the images that are returned for pictures.
    """

    split: str
    view: View | None = None
    head: TestedHead | None = None
    corruption: CorruptionRequest | None = None
    keep: Collection[str] = ()

    @classmethod
    def from_options(
        cls,
        split: str,
        modality: str,
        head: str = AS_TRAINED,
        corruption: CorruptionRequest | None = None,
    ) -> EvaluationRequest:
        """Of the options that commands have.

        Raises:
            InputError: there is no such modality.
        """
        check_choice("modality", modality, (DEFAULT_VIEW, *VIEWS))
        return cls(
            split=split,
            view=None if modality == DEFAULT_VIEW else cast(View, modality),
            head=None if head == AS_TRAINED else cast(TestedHead, head),
            corruption=corruption,
        )
