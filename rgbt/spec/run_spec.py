"""The complete description of one run, made once from the composed configuration.

Other code reads settings and objects from here and never the configuration itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

from rgbt.config.component import Component
from rgbt.config.stored_config import EXTERNAL
from rgbt.data.domains import GIVEN, NONE, Domains
from rgbt.data.loader_settings import LOADING, OF_RARE_CLASSES, LoaderSettings
from rgbt.engine.prediction import Prediction
from rgbt.engine.settings import OF_MACHINE, Recipe, Scale, TrainerSettings
from rgbt.ranges import Seed, Text
from rgbt.spec.checkout_code import code_of, content_of
from rgbt.spec.node import Node, node_field
from rgbt.spec.run_key import file_digest, manifest_of, settings_digest, weights_file
from rgbt.spec.seeds import Seeds, SourceSeeds

WEIGHTS = "model.weights"
"""The setting that names the weights that a network starts from."""

CheckpointFile = Literal["best.pt", "last.pt"]


def labels_key(domain: str) -> str:
    """The setting that names the labels of a domain."""
    return f"domains.{domain}.labels"


def _value(annotation: Any, *, shared: bool = False, is_label: bool = False) -> Any:
    return field(metadata={"value": annotation, "shared": shared, "is_label": is_label})


@dataclass(frozen=True)
class Dependency:
    """An upstream run, and what is taken from it.

    Attributes:
        key: the setting that names it: "model.weights" or "domains.target.labels".
        run: the upstream run.
        checkpoint: the file that is taken: "best.pt" or "last.pt".
        is_common: whether the upstream run keeps its own seed and data set.
    """

    key: str
    run: RunSpec
    checkpoint: CheckpointFile
    is_common: bool = False

    @property
    def path(self) -> Path:
        """The checkpoint file."""
        return self.run.folder / self.checkpoint


@dataclass(frozen=True, kw_only=True, eq=False)
class RunSpec:
    """The typed, frozen description of one run.

    Attributes:
        name: of its experiment.
        seed: of every generator, but for those that `seeds` names.
        runs_dir: the folder of run folders.
        fresh: whether a finished run is trained again.
        pretrained: file of ImageNet weights that the network, or that of its first upstream run,
            starts from.
        out: where a command that draws or predicts writes.
        overrides: as typed on the command line, for the name of the run.
        plain: the whole configuration as resolved YAML values, for ``config.yaml``.
        components: every node, checked.
        dependencies: the upstream runs, in the order in which they are needed.
    """

    name: str = _value(Text, is_label=True)
    seed: int = _value(Seed, shared=True)
    runs_dir: str = _value(Text, shared=True, is_label=True)
    fresh: bool = _value(bool)
    pretrained: str | None = _value(Text | None, shared=True)
    out: str | None = _value(Text | None, is_label=True)

    scale: Scale = node_field(in_key=False)
    recipe: Recipe = node_field(in_key=False)
    dataset: Component = node_field(
        outside_key=("root", "cache_dir", "palette", "background", "layout", "absent"),
        added={"vignette": 0.18, "whole_shadows": False},
        shared=True,
    )
    domains: Domains = node_field(
        added_as={
            "_target_": "rgbt.data.domains.Domains",
            "source": {
                "_target_": "rgbt.data.domains.Domain",
                **{"split": "train", "view": None, "head": None, "labels": "given"},
                **{"teacher_view": None, "threshold": 0.0, "confidence": False},
            },
            **{"target": None, "target_is": None, "tested_head": "own"},
        }
    )
    seeds: Seeds = node_field(
        added_as={
            "_target_": "rgbt.spec.seeds.Seeds",
            **{"weights": None, "order": None, "masks": None},
        },
        shared=True,
    )
    data: LoaderSettings = node_field(
        outside_key=LOADING,
        added={"sampling": "shuffled"},
        used_with=dict.fromkeys(OF_RARE_CLASSES, ("sampling", "rare_classes")),
        shared=("batch_size", *LOADING),
    )
    transform: Component = node_field()
    masker: Component = node_field()
    model: Component = node_field(
        added={"mask_token": "branch"},
        renamed={"decoder": {"modified_heatnet": "modified_released"}},
    )
    loss: Component = node_field()
    scheme: Component = node_field(
        added={"resolution": "full", "idle_steps": "none", "feature_distance": None}
    )
    optimizer: Component = node_field(added={"head_rate": "scheduled"})
    schedule: Component = node_field()
    trainer: TrainerSettings = node_field(
        outside_key=OF_MACHINE,
        added={"tested": "best", "threads": 2, "batch_norm_parts": 1, "averaging": "none"},
        used_with={"ema_decay": ("averaging", "ema"), "averaged_share": ("averaging", "last")},
        shared=("max_steps", "eval_every", "precision", "threads", "batch_norm_parts", *OF_MACHINE),
    )
    metric: Component = node_field(shared=True)
    prediction: Prediction = node_field(
        added_as={
            "_target_": "rgbt.engine.prediction.Prediction",
            **{"align_corners": False, "mirrored": False, "scales": [1.0], "window_hw": None},
            **{"window_stride": 2 / 3, "enlarged": "scores", "counted": "label"},
            "label_resize": "nearest",
        }
    )
    consistency: Component = node_field(in_key=False)
    tracking: Component = node_field(in_key=False, shared=True)

    overrides: tuple[str, ...] = ()
    plain: Mapping[str, Any] = field(repr=False)
    components: Mapping[str, Component] = field(repr=False)
    dependencies: tuple[Dependency, ...] = ()

    @cached_property
    def key(self) -> str:
        """12 hexadecimal digits that identify the run: a hash of what decides its result.

        Paths, hardware, labels and tracking (`NOT_IN_KEY`) are left out, so that the same method
        with the same seed is the same run on every machine. A file of weights, or a folder of
        pseudo-labels, counts by its content and not by its path, as the checkout of another author
        does; an upstream run by its key, and it need not exist yet.

        Raises:
            InputError: the file of weights, the folder of pseudo-labels or the checkout is missing.
        """
        settings: dict[str, Any] = {"seed": self.seed}
        if self.weights is not None:
            settings["weights"] = [self._content(WEIGHTS, self.weights), *self.fresh_parts]
        for name, node in NODES.items():
            values = self.components[name].canonical()
            if name == "domains":
                for domain, each in self.domains.named.items():
                    values[domain]["labels"] = self._content(labels_key(domain), each.labels)
            if name == "seeds":  # the seed of the run, typed or not, is the same run
                values = {k: None if v == self.seed else v for k, v in values.items()}
                values.pop("start", None)  # the key of the start stands for it
            if name == "model" and self.model.target == EXTERNAL:
                values["checkout"] = content_of(self.model.plain)
            settings |= node.key_settings(name, values)
        return settings_digest(settings)

    @property
    def drawn(self) -> SourceSeeds:
        """The seed of every source of random draws."""
        return self.seeds.filled(self.seed)

    @property
    def folder(self) -> Path:
        """The run folder."""
        return Path(self.runs_dir) / self.key

    @property
    def is_finished(self) -> bool:
        """Whether the run has its result."""
        return (self.folder / "result.json").exists()

    @property
    def upstream(self) -> tuple[RunSpec, ...]:
        """The runs that this one depends on."""
        return tuple(each.run for each in self.dependencies)

    def dependency(self, key: str) -> Dependency | None:
        """The upstream run that the setting `key` names; None where it names none."""
        return next((each for each in self.dependencies if each.key == key), None)

    @property
    def weights(self) -> str | None:
        """`model.weights`: a file, a run folder, or "experiment:NAME/best.pt"."""
        return cast("str | None", self.model.plain.get("weights"))

    @property
    def fresh_parts(self) -> tuple[str, ...]:
        """`model.fresh`: beginnings of parameter names that keep their random start."""
        return tuple(self.model.plain.get("fresh") or ())

    @property
    def weights_path(self) -> Path | None:
        """The file that `model.weights` names; of a run folder its best checkpoint.

        Raises:
            InputError: there is no such file, or the upstream run is not finished.
        """
        if self.weights is None:
            return None
        dependency = self.dependency(WEIGHTS)
        return weights_file(self.weights if dependency is None else str(dependency.path))

    def labels_folder(self, domain: str) -> Path | None:
        """The folder of pseudo-labels of "source" or "target"; None where it takes none."""
        settings = self.domains.named[domain]
        dependency = self.dependency(labels_key(domain))
        if dependency is not None:
            words = [settings.split, settings.teacher_view or "default"]
            words += [dependency.checkpoint.removesuffix(".pt")]
            words += [f"{settings.threshold:g}"] if settings.threshold else []
            return dependency.run.folder / "pseudo_labels" / "_".join(words)
        is_folder = settings.labels not in (GIVEN, NONE)
        return Path(settings.labels).expanduser() if is_folder else None

    @property
    def uses_pretrained(self) -> bool:
        """Whether this run, or one upstream of it, starts from the file `pretrained`."""
        return self.weights == self.pretrained or any(
            each.run.uses_pretrained for each in self.dependencies
        )

    def with_seed(self, seed: int) -> RunSpec:
        """The same run with another seed; its upstream runs have it too.

        Common ones keep theirs, unless `seeds.start` is "run".
        """
        words = [word for word in self.overrides if not word.startswith("seed=")]
        further = seed - self.seed if self.seeds.start == "run" else 0

        def seed_of(each: Dependency) -> int:
            return each.run.seed + further if each.is_common else seed

        upstream = (
            replace(each, run=each.run.with_seed(seed_of(each))) for each in self.dependencies
        )
        return replace(
            self,
            seed=seed,
            overrides=(*words, f"seed={seed}"),
            plain={**self.plain, "seed": seed},
            dependencies=tuple(upstream),
        )

    def own_code(self) -> dict[str, str]:
        """Digest or version of all code in the run that is not ours, by module (see `code_of`)."""
        return code_of(self.plain)

    def _content(self, key: str, value: str) -> str:
        """The digest or key that represents a file, a folder or an upstream run in the key."""
        dependency = self.dependency(key)
        if dependency is not None:
            return f"{dependency.run.key}/{dependency.checkpoint}"
        if key == WEIGHTS:
            path = self.weights_path
            assert path is not None, "model.weights has a value"
            return file_digest(path)
        return value if value in (GIVEN, NONE) else str(manifest_of(key, value)["digest"])


NODES: dict[str, Node] = {
    each.name: each.metadata["node"] for each in fields(RunSpec) if "node" in each.metadata
}
"""Every node of the configuration with its policy."""

RENAMED = tuple(
    (f"{key}.{setting}", now, before)
    for key, node in NODES.items()
    for setting, names in node.renamed.items()
    for now, before in names.items()
)
"""Dotted key, present and previous name of every value that was renamed."""

VALUES: dict[str, Any] = {
    each.name: each.metadata["value"] for each in fields(RunSpec) if "value" in each.metadata
}
"""Every plain value at the top of the configuration with its type."""

NOT_IN_KEY = (
    *(each.name for each in fields(RunSpec) if each.metadata.get("is_label")),
    *(key for key, node in NODES.items() if not node.in_key),
    *(f"{key}.{each}" for key, node in NODES.items() for each in node.outside_key),
)
"""Dotted keys in which two configurations of one run may differ."""

SHARED = (
    *(each.name for each in fields(RunSpec) if each.metadata.get("shared")),
    *(key for key, node in NODES.items() if node.shared is True),
    *(
        f"{key}.{each}"
        for key, node in NODES.items()
        if not isinstance(node.shared, bool)
        for each in node.shared
    ),
)
"""Dotted keys that an upstream run has in common with the run that needs it, beside the sizes of
the scale. A duration is that of the scale unless it was typed."""

SHARED_BY_COMMON = (
    *(key for key in SHARED if key in NOT_IN_KEY),
    *(
        f"{key}.{each}"
        for key, node in NODES.items()
        if node.shared is True and key != "dataset"
        for each in node.outside_key
    ),
)
"""Dotted keys that a common upstream run takes over from the run that needs it first. None of them
enters the run key, so that it is one run for all seeds and data sets."""
