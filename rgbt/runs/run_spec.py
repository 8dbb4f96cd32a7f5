"""The complete description of one run: its settings, its key and the runs that it depends on.

It is made of the composed configuration alone. Key and folder import no class that the settings
name, so that a finished run is found without torch. A node is checked against its constructor when
it is first used, or all of them by `RunSpec.check`. Other code reads settings and objects from here
and never the configuration itself.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, cast, overload

from rgbt.checks import InputError
from rgbt.config.component import Component, checked_nodes, objects
from rgbt.config.stored_config import EXTERNAL, targets
from rgbt.config.values import check_value
from rgbt.data.domains import GIVEN, NONE, Domain, Domains
from rgbt.data.loader_settings import LOADING, LoaderSettings
from rgbt.engine.prediction import Prediction
from rgbt.engine.settings import MACHINE_SETTINGS, Recipe, Scale, TrainerSettings
from rgbt.files.atomic import is_held
from rgbt.files.plain_files import file_digest, read_json
from rgbt.ranges import Seed, Text
from rgbt.runs.folder import is_finished
from rgbt.runs.source_code import checkout_code, code_of, user_code
from rgbt.runs.starts import IMAGENET, packaged, packaged_start

if TYPE_CHECKING:
    from rgbt.runs.result import RunResult

# The setting that names the weights that a network starts from.
WEIGHTS = "model.weights"

CheckpointFile = Literal["best.pt", "last.pt"]

T = TypeVar("T")


def labels_key(domain: str) -> str:
    """Return the setting that names the labels of a domain."""
    return f"domains.{domain}.labels"


class Node(Generic[T]):
    """A node of the configuration as an attribute of `RunSpec`, checked at its first use.

    Args:
        kind: of the attribute: `Component`, which is built later, or the class of the settings.
        in_key: whether the node is part of the run key.
        outside_key: settings of it that are not: paths, hardware and labels.
        shared: whether upstream runs take it over from the run that needs them; or which of its
            settings.
    """

    def __init__(
        self,
        kind: type[T],
        *,
        in_key: bool = True,
        outside_key: tuple[str, ...] = (),
        shared: bool | tuple[str, ...] = False,
    ) -> None:
        self.kind = kind
        self.in_key = in_key
        self.outside_key = outside_key
        self.shared = shared

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, spec: None, owner: type) -> Node[T]: ...

    @overload
    def __get__(self, spec: RunSpec, owner: type) -> T: ...

    def __get__(self, spec: RunSpec | None, owner: type) -> Node[T] | T:
        if spec is None:
            return self
        spec.use([self._name])  # an attribute of the object from now on
        return cast(T, vars(spec)[self._name])


@dataclass(frozen=True, kw_only=True)
class Seeds:
    """Seeds of single sources of random draws; None: that source uses the seed of the run.

    Attributes:
        weights: initial weights of the network and of a discriminator.
        order: order of the training images, and their augmentation.
        masks: all draws of the training steps: masks, dropped layers (stochastic depth), points
            at which masks are compared, and virtual views.
        start: seed of the common start (``common:NAME/last.pt``). "common": that of its experiment,
            so that all seeds begin with the same weights; "run": the same plus the seed of the run,
            so that every seed begins with other weights, and all methods with those of their seed.
    """

    weights: Seed | None = None
    order: Seed | None = None
    masks: Seed | None = None
    start: Literal["common", "run"] = "common"


# Types of the plain values at the top of the configuration.
VALUES: dict[str, Any] = {
    "name": Text,
    "seed": Seed,
    "runs_dir": Text,
    "fresh": bool,
    "pretrained": Text | None,
    "out": Text | None,
}


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


@dataclass(frozen=True, kw_only=True, eq=False)
class RunSpec:
    """The typed, frozen description of one run.

    Attributes:
        plain: the whole configuration as resolved YAML values, for ``config.yaml``.
        overrides: as typed, for the name of the run.
        dependencies: the upstream runs, in the order in which they are needed.
        fresh: whether a finished run is trained again.
    """

    plain: Mapping[str, Any] = field(repr=False)
    overrides: tuple[str, ...] = ()
    dependencies: tuple[Dependency, ...] = ()
    fresh: bool = False

    scale = Node(Scale, in_key=False)
    recipe = Node(Recipe, in_key=False)
    dataset = Node(
        Component,
        outside_key=("root", "cache_dir", "palette", "background", "layout", "absent"),
        shared=True,
    )
    domains = Node(Domains)
    seeds = Node(Seeds, shared=True)
    data = Node(LoaderSettings, outside_key=LOADING, shared=("batch_size", *LOADING))
    transform = Node(Component)
    masker = Node(Component)
    model = Node(Component)
    loss = Node(Component)
    scheme = Node(Component)
    optimizer = Node(Component)
    schedule = Node(Component)
    trainer = Node(
        TrainerSettings,
        outside_key=MACHINE_SETTINGS,
        shared=(
            "max_steps",
            "eval_every",
            "precision",
            "threads",
            "batch_norm_parts",
            *MACHINE_SETTINGS,
        ),
    )
    metric = Node(Component, shared=True)
    prediction = Node(Prediction)
    consistency = Node(Component, in_key=False)
    tracking = Node(Component, in_key=False, shared=True)

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return str(self.plain["name"])

    @property
    def seed(self) -> int:
        """Seed of every generator, but for those that `seeds` names."""
        return int(self.plain["seed"])

    def check(self) -> RunSpec:
        """Check all settings, here and upstream, and return this; InputError names a wrong one."""
        for key, kind in VALUES.items():
            check_value(key, self.plain[key], kind)
        self.use([name for name in NODES if name not in vars(self)])
        for run in self.upstream:
            run.check()
        return self

    def use(self, names: Iterable[str]) -> None:
        """Check nodes and make them attributes: settings are built, other components later."""
        found = checked_nodes(self.plain, names, [n for n in NODES if NODES[n].kind != Component])
        vars(self).update(found)

    def build(self, *names: str, **collaborators: Any) -> dict[str, Any]:
        """Return attributes by name; of components objects, with those collaborators they take."""
        return objects({name: getattr(self, name) for name in names}, collaborators)

    @cached_property
    def key(self) -> str:
        """12 hexadecimal digits that identify the run: a hash of what decides its result.

        SHA-256 of the nodes in the key as resolved YAML values, of the seeds, and of the user's
        own code. Paths, hardware, labels and tracking (`NOT_IN_KEY`) are left out, so that the same
        method with the same seed is the same run on every machine. A file of weights, a folder of
        pseudo-labels and the checkout of another author count by their content, an upstream run by
        its key; it need not exist yet.

        Raises:
            InputError: the file of weights, the folder of pseudo-labels or the checkout is missing.
        """
        settings = _settings_in_key(self.plain)
        model, domains = settings["model"], settings["domains"]
        if self.weights is not None:
            model["weights"] = self._content(WEIGHTS, self.weights)
        for name in ("source", "target"):
            if domains[name] is not None:
                labels = self._content(labels_key(name), domains[name]["labels"])
                domains[name] = {**domains[name], "labels": labels}
        seeds = [self.seed_of("weights"), self.seed_of("order"), self.seed_of("masks")]
        code = user_code(targets(settings).values())
        if model.get("_target_") == EXTERNAL:
            if not (found := checkout_code(self.plain["model"])):
                raise InputError(
                    f"model.checkout={model['checkout']}: expected a folder that has the module of "
                    f"model.constructor={model['constructor']} in model.root={model['root']}."
                )
            model["checkout"] = dict(found)
        return _digest({**settings, "seeds": seeds, "code": code})

    def is_run(self, run: RunResult) -> bool:
        """Say whether a stored run is this one: by its key, or without a checkout by settings.

        An external network has no key where its checkout is not here.
        """
        model = self.plain["model"]
        if model.get("_target_") != EXTERNAL or checkout_code(model):
            return self.key == run.key
        # Runs are archived for years: how often they saved, say, has other names today.
        known = self.plain["trainer"]
        trainer = {key: value for key, value in run.settings["trainer"].items() if key in known}
        return settings_digest(self.plain) == settings_digest({**run.settings, "trainer": trainer})

    @property
    def names_files(self) -> bool:
        """Whether the key depends on files of its own, or of a run upstream: weights, labels, code.

        Such a stored run is compared by its settings: a stranger's files are not opened.
        """
        if self.plain["model"].get("_target_") == EXTERNAL:
            return True
        named = {WEIGHTS: self.weights}
        for name in ("source", "target"):
            domain = self.plain["domains"][name] or {}
            named[labels_key(name)] = domain.get("labels")
        for key, value in named.items():
            if value not in (None, GIVEN, NONE) and self.dependency(key) is None:
                return True
        return any(run.names_files for run in self.upstream)

    def seed_of(self, source: Literal["weights", "order", "masks"]) -> int:
        """Return the seed of a source of random draws, an attribute of `Seeds`."""
        own: int | None = getattr(self.seeds, source)
        return self.seed if own is None else own

    @property
    def folder(self) -> Path:
        """The run folder."""
        return Path(self.plain["runs_dir"]) / self.key

    @property
    def is_finished(self) -> bool:
        """Whether the run has its result."""
        return is_finished(self.folder)

    @property
    def is_locked(self) -> bool:
        """Whether a process is training the run now."""
        return is_held(self.folder / "lock")

    @property
    def pending(self) -> tuple[RunSpec, ...]:
        """The unfinished runs upstream of this one, each after those it depends on; then this."""
        order: dict[str, RunSpec] = {}
        for spec in self.upstream:
            if not spec.is_finished:
                order |= {run.key: run for run in spec.pending}
        return (*order.values(), self)

    @property
    def upstream(self) -> tuple[RunSpec, ...]:
        """The runs that this one depends on."""
        return tuple(dependency.run for dependency in self.dependencies)

    def dependency(self, key: str) -> Dependency | None:
        """Return the upstream run that the setting `key` names; None where it names none."""
        for dependency in self.dependencies:
            if dependency.key == key:
                return dependency
        return None

    @property
    def weights(self) -> str | None:
        """`model.weights`: a file, a run folder, "imagenet", or "experiment:NAME/best.pt"."""
        return cast("str | None", self.plain["model"].get("weights"))

    @property
    def weights_path(self) -> Path | None:
        """The file of `model.weights`, of a folder its best checkpoint; InputError without it."""
        if self.weights is None:
            return None
        if self.weights == IMAGENET:
            return packaged(self.plain["model"])
        dependency = self.dependency(WEIGHTS)
        path = Path(self.weights).expanduser()
        if dependency is not None:
            path = dependency.run.folder / dependency.checkpoint
        path = path / "best.pt" if path.is_dir() else path
        if not path.is_file():
            raise InputError(
                f"model.weights={self.weights}: {path} does not exist; give a file or a run folder."
            )
        return path

    @property
    def missing_labels(self) -> list[tuple[Dependency, Domain, Path]]:
        """Upstream runs whose pseudo-labels are not there yet, with their domain and folder."""
        missing = []
        for name, domain in self.domains.named.items():
            teacher, folder = self.dependency(labels_key(name)), self.labels_folder(name)
            if teacher is not None and folder is not None and not folder.is_dir():
                missing.append((teacher, domain, folder))  # renamed when complete
        return missing

    def labels_folder(self, domain: str) -> Path | None:
        """Return the folder of pseudo-labels of "source" or "target"; None where it takes none."""
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
        is_here = self.weights == self.plain["pretrained"]
        return is_here or any(run.uses_pretrained for run in self.upstream)

    def with_seed(self, seed: int) -> RunSpec:
        """Return the run with another seed, and so its upstream runs but a common start of all."""
        words = [word for word in self.overrides if not word.startswith("seed=")]
        further = seed - self.seed if self.seeds.start == "run" else 0
        upstream = []
        for dependency in self.dependencies:
            run = dependency.run
            changed = run.with_seed(run.seed + further if dependency.is_common else seed)
            upstream.append(replace(dependency, run=changed))
        found = replace(
            self,
            overrides=(*words, f"seed={seed}"),
            plain={**self.plain, "seed": seed},
            dependencies=tuple(upstream),
        )
        # No node depends on the seed: those that were checked stay.
        vars(found).update({name: vars(self)[name] for name in NODES if name in vars(self)})
        return found

    def own_code(self) -> dict[str, str]:
        """Return the digest or version of all code in the run that is not ours (see `code_of`)."""
        return code_of(self.plain)

    def _content(self, key: str, value: str) -> str:
        """Return what represents a file, a folder or an upstream run in the key: digest or key."""
        dependency = self.dependency(key)
        if dependency is not None:
            return f"{dependency.run.key}/{dependency.checkpoint}"
        if key == WEIGHTS and value == IMAGENET:
            return packaged_start(self.plain["model"]).digest  # also where it is not installed
        if key == WEIGHTS:
            path = self.weights_path
            assert path is not None, "model.weights has a value"
            return file_digest(path)
        if value in (GIVEN, NONE):
            return value
        manifest = Path(value).expanduser() / "pseudo_labels.json"
        found = read_json(manifest, dict[str, Any], "predict again") if manifest.is_file() else {}
        if "digest" not in found:
            raise InputError(
                f"{key}={value}: expected given, none, experiment:NAME/best.pt, or a folder that "
                "rgbt predict ... pseudo_labels=true has written."
            )
        return str(found["digest"])


def settings_digest(plain: Mapping[str, Any]) -> str:
    """Return 12 hexadecimal digits of the settings in the run key as written, without content.

    A checkpoint holds them, so that a ``config.yaml`` that was changed since is noticed without the
    files and upstream runs that the key depends on. Runs of a checkout that is not here are told by
    them.
    """
    settings = _settings_in_key(plain)
    for path in ("model.weights", "model.checkout", "domains.source", "domains.target"):
        node, _, key = path.partition(".")
        settings[node].pop(key, None)
    return _digest({**settings, "seed": plain.get("seed")})


def _settings_in_key(plain: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Copy the nodes in the key, without their settings that are not."""
    found: dict[str, dict[str, Any]] = {}
    for name, node in NODES.items():
        if node.in_key:
            found[name] = dict(plain.get(name, {}))
            for key in node.outside_key:
                found[name].pop(key, None)
    return found


def _digest(settings: Mapping[str, Any]) -> str:
    text = json.dumps(_plain_numbers(settings), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _plain_numbers(value: Any) -> Any:
    """Return `value` with 4 for 4.0, which are one setting."""
    if isinstance(value, Mapping):
        return {str(key): _plain_numbers(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain_numbers(inner) for inner in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


# Every node of the configuration with its policy.
NODES: dict[str, Node[Any]] = {
    name: node for name, node in vars(RunSpec).items() if isinstance(node, Node)
}


def _outside_key() -> Iterator[str]:
    yield from ("name", "runs_dir", "out")
    for name, node in NODES.items():
        if not node.in_key:
            yield name
        for key in node.outside_key:
            yield f"{name}.{key}"


# Dotted keys in which two configurations of one run may differ.
NOT_IN_KEY = tuple(_outside_key())


def is_in_key(key: str) -> bool:
    """Say whether the setting with a dotted key is part of the run key."""
    return not any(key == out or key.startswith(f"{out}.") for out in NOT_IN_KEY)
