"""The requests for an evaluation: a trained network, a corruption of its images, and the rest.

``corruption=NAME`` names a file of ``conf/corruption/``, ``corruption=NAME:IMAGE`` sets its `image`
as well, and ``corruption=my.yaml`` names a file of your own; ``corruption.KEY=...`` changes a
setting, ``corruption.seed=1`` what is drawn.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np
from omegaconf import OmegaConf

from rgbt.assembly.contracts import check_sample, is_own
from rgbt.assembly.load_run import open_network
from rgbt.assembly.session import Session
from rgbt.checks import InputError, check_choice, split_list
from rgbt.config.common_options import AS_TRAINED, NetworkOptions
from rgbt.config.component import build, constructor, setting_types
from rgbt.config.compose import conf_dir
from rgbt.config.stored_config import load_config, parse_trust
from rgbt.config.values import check_value
from rgbt.corruptions.kinds import Corruption, OfTime
from rgbt.data.domains import TestedHead
from rgbt.dataset import DatasetWrapper, LabelledDataset
from rgbt.files.yaml_files import parse_yaml
from rgbt.randomness import numpy_generator
from rgbt.ranges import Seed
from rgbt.runs.naming import row_name
from rgbt.types import VIEWS, Sample, View

if TYPE_CHECKING:
    from rgbt.data.label_map import LabelMap
    from rgbt.data.new_images import ToPredict
    from rgbt.metrics.details import Details

DEFAULT_VIEW, BEST = "default", "best"  # values of the options `modality` and `checkpoint`
CHANGES = ("transform", "trainer.precision", "metric", "prediction")  # the counts or scores


@dataclass(frozen=True)
class NetworkRequest:
    """A trained network with overrides of its configuration, and a file of ``conf/metric``."""

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
        """InputError where counts with other settings would lie beside those of the run."""
        changed = [word for word in self.overrides if word.lstrip("+").startswith(CHANGES)]
        if changed and self.options.run and not out:
            raise InputError(f"{changed[0]} changes how the run is measured; add out=FOLDER.")

    def open(self, label_map: LabelMap | None = None) -> Session:
        """The network of a run, of a file of weights, or an exported one (`open_network`)."""
        options = self.options
        regions = [] if self.regions == AS_TRAINED else [f"metric={self.regions}"]
        words = [*self.overrides, *regions]
        if options.run and options.exported is not None:
            raise InputError("exported: it has its own weights; omit run=.")
        source = options.exported or options.run
        return open_network(
            source, options.runs_dir, words, options.checkpoint, label_map, self.trust
        )


def other_images(dataset: LabelledDataset, marker: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Part of a file name if a run is measured on other data than those of its ``dataset.json``."""
    trained_on = (marker or {}).get("files")
    if trained_on in (None, found := dataset.fingerprint()):
        return ()
    return (f"{dataset.name.replace('/', '_')}-{found[:8]}",)


Statistics = Literal["recomputed", "adabn", "batch"]


@dataclass(frozen=True, kw_only=True)
class BatchNormRequest:
    """Statistics of batch normalisation that replace those of the training; no label is read.

    Attributes:
        kind: "recomputed": over all images; "adabn": those of the images by day for images by day,
            and those of the night for the night; "batch": those of each batch, by day or of the
            night alone.
        splits: whose images they are computed from; (): the evaluated split.
    """

    kind: Statistics
    splits: tuple[str, ...] = ()

    @classmethod
    def from_options(cls, kind: str, splits: str) -> BatchNormRequest | None:
        """The request of the options of a command; InputError for splits without effect."""
        if splits and kind in (AS_TRAINED, "batch"):
            raise InputError(f"batch_norm_splits={splits} has no effect with batch_norm={kind}.")
        if kind == AS_TRAINED:
            return None
        named = dict.fromkeys(split_list(splits, "batch_norm_splits") if splits else ())
        return cls(kind=cast(Statistics, kind), splits=tuple(named))

    @property
    def file_stem(self) -> str:
        """Part of file names: "norm-adabn", "norm-adabn-train_day-train_night"."""
        return "-".join(("norm", self.kind, *self.splits))

    @property
    def title(self) -> str:
        """Text of titles: "AdaBN", "AdaBN of train_day, train_night"."""
        title = "AdaBN" if self.kind == "adabn" else f"{self.kind} statistics"
        return f"{title} of {', '.join(self.splits)}" if self.splits else title


NODE = "corruption"


@dataclass(frozen=True)
class CorruptionRequest:
    """A corruption with a severity; 0: the images as they are.

    `name` is that of files of counts, such as "noise_rgb"; `changes` are the typed ``key=value``
    words that differ from the file.
    """

    name: str
    corruption: Corruption
    changes: tuple[str, ...] = ()
    seed: int = 0
    severity: float = 0.0

    @property
    def row(self) -> str:
        """The name that all its severities share: "occluded", or "occluded_block-16" if changed."""
        return self._with_changes(self.name)

    @property
    def file_stem(self) -> str:
        """Part of file names: "occluded-0.5", "occluded-0.5_block-16" where that was changed."""
        return self._with_changes(f"{self.name}-{self.severity:g}")

    def _with_changes(self, first: str) -> str:
        drawn = [f"seed={self.seed}"] if self.seed else []
        return "_".join(re.sub(r"[^\w.]+", "-", word) for word in (first, *self.changes, *drawn))

    @property
    def title(self) -> str:
        """Text of titles: "occluded, thermal 0.5 (share of blocks)"."""
        kind = self.corruption
        return f"{kind.title} {self.severity:g} ({kind.unit})" if kind.unit else kind.title

    def ladder(self) -> tuple[CorruptionRequest, ...]:
        """The same at each severity of its ladder."""
        return tuple(replace(self, severity=each) for each in self.corruption.severities)

    def at(self, severity: str) -> CorruptionRequest:
        """The same at the severity that was typed; a ladder of one needs none."""
        ladder = self.corruption.severities
        if not severity and len(ladder) == 1:
            return replace(self, severity=ladder[0])
        value = check_value("severity", parse_yaml(severity, "severity"), float)
        if value:
            self.corruption.check(value)
        return replace(self, severity=value)

    def identity(self) -> dict[str, Any]:
        """The settings that determine the images, as JSON values."""
        known = ("title", "unit", "severities")
        settings = {k: value for k, value in vars(self.corruption).items() if k not in known}
        return {
            "name": self.name,
            "kind": type(self.corruption).__name__,
            "settings": settings,
            "severity": self.severity,
            "seed": self.seed,
        }

    def applied_to(self, session: Session, split: str) -> Session:
        """`session` that reads `split` under this corruption."""
        kind, dataset = self.corruption, CorruptedDataset(session.dataset, self, split)
        if is_own(kind) and not isinstance(kind, OfTime):
            first = dataset.names(split)[0]
            returned = f"corruption: {type(kind).__name__}.__call__ returned"
            check_sample(returned, dataset.read(first), first)
        return replace(session, dataset=dataset)

    def images(self, images: ToPredict, session: Session, source: str) -> ToPredict:
        """`images` of `source` under this corruption; one of time needs a split as source."""
        dataset, read = session.dataset, images.read
        if isinstance(self.corruption, OfTime):
            check_choice("input", source, dataset.splits)
        # Corruptions of pixels do not depend on the split.
        split = source if source in dataset.splits else next(iter(dataset.splits))
        corrupted = CorruptedDataset(dataset, self, split)
        return replace(images, read=lambda name: corrupted.corrupted(name, read))


class CorruptedDataset(DatasetWrapper):
    """`source` under a corruption; `split` gives the order of time.

    Names, labels and the fingerprint are those of the source: scores refer to the same images.
    Random draws for an image depend only on (seed, image name).
    """

    def __init__(self, source: LabelledDataset, request: CorruptionRequest, split: str) -> None:
        super().__init__(source)
        self.request = request
        self._earlier: dict[str, str] = {}
        kind, severity = request.corruption, request.severity
        if severity:
            kind.check(severity)
        if severity and isinstance(kind, OfTime):
            names = source.names(split)
            nights = source.nights(names) or (False,) * len(names)
            for dark in (False, True):
                frames = [name for name, night in zip(names, nights, strict=True) if night == dark]
                for index, name in enumerate(frames):
                    self._earlier[name] = frames[kind.shown(index, severity)]

    def read(self, name: str) -> Sample:
        """The sample called `name` under the corruption; errors are those of `corrupted`."""
        return self.corrupted(name, self.source.read)

    def corrupted(self, name: str, read: Callable[[str], Sample]) -> Sample:
        """What `read` returns of `name`, under the corruption.

        Raises:
            InputError: as `read`; an image that is not of the split, or of another size than the
                frame that it shows; a severity that changes nothing of an image of this size.
        """
        sample, kind = read(name), self.request.corruption
        if not self.request.severity:
            return sample
        if isinstance(kind, OfTime):
            if name not in self._earlier:
                raise InputError(f"'{name}' is not in the split whose order says what it shows.")
            other = read(self._earlier[name])
            if other.thermal.shape != sample.thermal.shape:
                raise InputError(f"'{name}' and '{other.name}', which it shows, differ in size.")
            return replace(sample, thermal=other.thermal)

        def rng_of(purpose: str) -> np.random.Generator:
            # This word is part of the seed and must not change.
            return numpy_generator(self.request.seed, f"degradation {purpose} of {name}")

        return kind(sample, self.request.severity, rng_of)


def corruption_files() -> dict[str, Path]:
    """Name -> file of ``conf/corruption/``."""
    return {path.stem: path for path in sorted((conf_dir() / NODE).glob("*.yaml"))}


def standard_corruptions() -> list[str]:
    """Every file of ``conf/corruption/`` with each image that its class can corrupt, by row."""
    found = []
    for name, path in corruption_files().items():
        types = setting_types(constructor(load_config(path)["_target_"], NODE))
        images = get_args(types["image"]) if "image" in types else ("both",)
        found += [name if each == "both" else f"{name}:{each}" for each in images]
    return sorted(found, key=row_name)


def choose_corruption(
    name: str, words: Sequence[str] = (), trust: Collection[str] = ()
) -> CorruptionRequest:
    """The corruption NAME, NAME:IMAGE or FILE.yaml with ``corruption.KEY=VALUE``, at severity 0.

    `trust` are modules that the file may name (`rgbt.config.stored_config`).
    """
    is_file = name.endswith((".yaml", ".yml"))
    stem, _, image = (name, "", "") if is_file else name.partition(":")
    if not is_file:
        check_choice(NODE, stem, corruption_files())
    path = Path(name).expanduser() if is_file else corruption_files()[stem]
    typed = [*([f"image={image}"] if image else []), *(w.removeprefix(f"{NODE}.") for w in words)]
    config = OmegaConf.create({NODE: load_config(path, trust, NODE)})
    for key, _, value in (word.partition("=") for word in typed):
        OmegaConf.update(config, f"{NODE}.{key}", parse_yaml(value, f"{NODE}.{key}"))
    node = config[NODE]
    seed = check_value(f"{NODE}.seed", node.pop("seed", 0), Seed)
    corruption = build(node)
    # The image is part of the name of a shipped file, and a change of a user's file.
    unnamed = ("severities", "seed") if is_file else ("severities", "seed", "image")
    return CorruptionRequest(
        name=path.stem if is_file else row_name(f"{stem}:{node.get('image', '')}"),
        corruption=corruption,
        changes=tuple(word for word in typed if word.partition("=")[0] not in unnamed),
        seed=seed,
    )


def requested_corruption(
    name: str, severity: str, words: Sequence[str], trust: Collection[str]
) -> CorruptionRequest | None:
    """The corruption of ``corruption=`` and ``severity=``; None for "none"."""
    if name == "none" and (severity or words):
        raise InputError(f"corruption=none: {['severity', *words][-1]} has no effect.")
    return None if name == "none" else choose_corruption(name, words, trust).at(severity)


def choose_corruptions(
    text: str, words: Sequence[str], trust: Collection[str] = ()
) -> list[CorruptionRequest]:
    """The corruptions of ``corruptions=``: names with commas, or "all"; each once."""
    names = standard_corruptions() if text == "all" else split_list(text, "corruptions")
    others = [word for word in words if not word.startswith(f"{NODE}.seed=")]
    if others and len(names) > 1:
        raise InputError(f"'{others[0]}' is a setting of one corruption; corruptions={text}.")
    return [choose_corruption(name, words, trust) for name in dict.fromkeys(names)]


def split_overrides(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Overrides below ``corruption``, and the others."""
    own = [word for word in overrides if word.startswith(f"{NODE}.")]
    return own, [word for word in overrides if word not in own]


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """One evaluation of a network: segmentation, consistency, corrupted images or pseudo-labels.

    None means: the view, head and statistics of the run's configuration, and clean images. `keep`
    are names of the images that are returned for pictures.
    """

    split: str
    view: View | None = None
    head: TestedHead | None = None
    corruption: CorruptionRequest | None = None
    keep: Collection[str] = ()
    details: tuple[Details, ...] = ()
    batch_norm: BatchNormRequest | None = None

    @classmethod
    def from_options(
        cls,
        split: str,
        modality: str,
        head: str = AS_TRAINED,
        corruption: CorruptionRequest | None = None,
        details: tuple[Details, ...] = (),
    ) -> EvaluationRequest:
        """The request of the options of a command; InputError for an unknown modality."""
        check_choice("modality", modality, (DEFAULT_VIEW, *VIEWS))
        return cls(
            split=split,
            view=None if modality == DEFAULT_VIEW else cast(View, modality),
            head=None if head == AS_TRAINED else cast(TestedHead, head),
            corruption=corruption,
            details=details,
        )
