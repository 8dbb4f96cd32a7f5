"""What is evaluated: a trained network, and the request that every kind of evaluation takes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast, get_args

from rgbt.build.load_run import TrainedNetwork, open_trained
from rgbt.checks import InputError, check_choice
from rgbt.config.common_options import AS_TRAINED
from rgbt.config.stored_config import parse_trust
from rgbt.data.domains import TestedHead
from rgbt.data.label_map import LabelMap
from rgbt.evaluation.corruption_request import CorruptionRequest
from rgbt.types import VIEWS, View

DEFAULT_VIEW = "default"
BEST = "best"
"""Values of the options `modality` and `checkpoint` that change nothing."""

CHANGES = ("transform", "trainer.precision", "metric")
"""Settings by which the same run gives other counts, or other scores of them."""


class NetworkOptions(Protocol):
    """The options by which every command names a trained network."""

    @property
    def run(self) -> str:
        """A run, see `rgbt.config.common_options.Trained`."""
        ...

    @property
    def runs_dir(self) -> Path:
        """Folder of runs."""
        ...

    @property
    def checkpoint(self) -> str:
        """The name of a checkpoint: "best" or "last"."""
        ...

    @property
    def trust(self) -> str:
        """Trusted modules with commas."""
        ...


class ViewOptions(Protocol):
    """The option by which a command says what is predicted from."""

    @property
    def modality(self) -> str:
        """A view, or "default"."""
        ...


@dataclass(frozen=True, kw_only=True)
class NetworkRequest:
    """Which trained network is evaluated, and what is changed of its configuration.

    Attributes:
        run: folder, config key or MLflow run id; "": the network of `overrides` with
            `model.weights`.
        runs_dir: where runs lie.
        checkpoint: "best" or "last" of a run.
        regions: a file of ``conf/metric``; None: as trained.
        overrides: of the configuration of the run.
        trust: modules that this configuration may name (`rgbt.config.stored_config`).
    """

    run: str
    runs_dir: Path
    checkpoint: str
    regions: str | None
    overrides: tuple[str, ...]
    trust: tuple[str, ...]

    @classmethod
    def from_options(
        cls, options: NetworkOptions, overrides: Sequence[str], regions: str = AS_TRAINED
    ) -> NetworkRequest:
        """Of the options that all commands have, and ``regions`` where the command has it."""
        return cls(
            run=options.run,
            runs_dir=options.runs_dir,
            checkpoint=options.checkpoint,
            regions=None if regions == AS_TRAINED else regions,
            overrides=tuple(overrides),
            trust=parse_trust(options.trust),
        )

    @property
    def suffixes(self) -> tuple[str, ...]:
        """What names of files say of the checkpoint: nothing of the best."""
        return () if self.checkpoint == BEST else (self.checkpoint,)

    def check_comparable(self, out: Path | None) -> None:
        """Refuse to keep counts made in another way among those of the run.

        Raises:
            InputError: an override of `CHANGES`, and no folder of its own in `out`.
        """
        changed = [word for word in self.overrides if word.lstrip("+").startswith(CHANGES)]
        if changed and self.run and not out:
            raise InputError(
                f"{changed[0]} changes how the run is measured; name a folder for these counts "
                "with out=..."
            )

    def open(self, label_map: LabelMap | None = None) -> TrainedNetwork:
        """The network with its weights, see `rgbt.build.load_run.open_trained`."""
        regions = [f"metric={self.regions}"] if self.regions else []
        overrides = [*self.overrides, *regions]
        return open_trained(
            self.run, self.runs_dir, overrides, self.checkpoint, label_map, self.trust
        )


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
        options: ViewOptions,
        split: str,
        head: str = AS_TRAINED,
        corruption: CorruptionRequest | None = None,
    ) -> EvaluationRequest:
        """Of the option ``modality``, and ``head`` where the command has it.

        Raises:
            InputError: there is no such modality or head.
        """
        check_choice("modality", options.modality, (DEFAULT_VIEW, *VIEWS))
        check_choice("head", head, (AS_TRAINED, *get_args(TestedHead)))
        return cls(
            split=split,
            view=None if options.modality == DEFAULT_VIEW else cast(View, options.modality),
            head=None if head == AS_TRAINED else cast(TestedHead, head),
            corruption=corruption,
        )
