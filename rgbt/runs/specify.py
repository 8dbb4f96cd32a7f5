"""Make the specification of a run: of a composed configuration, or of a stored run.

A run names an upstream run by its experiment: ``model.weights=experiment:NAME/last.pt`` starts
from the last checkpoint of that run; ``domains.target.labels=experiment:NAME/best.pt`` trains on
the predictions of its network. Both runs share seed, scale and data set
(`SHARED`): a run of seed 2 depends on runs of seed 2.

``model.weights=common:NAME/last.pt`` names an upstream run that keeps its own data set: all methods
with the same network start from the same run. It also keeps its own seed, unless `seeds.start` says
that every seed has a start of its own.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, cast, get_args

from omegaconf import DictConfig, OmegaConf, open_dict

from rgbt.checks import InputError, nearest
from rgbt.config.component import RUN_SETTINGS
from rgbt.config.compose import (
    DEFAULT_SCALE,
    SEARCH_PATH,
    available,
    compose,
    flatten,
    own_folders,
    register_resolvers,
    resolved,
    top_level,
)
from rgbt.config.stored_config import KEY, targets
from rgbt.config.values import check_value
from rgbt.files.yaml_files import parse_yaml
from rgbt.ranges import Seed
from rgbt.runs.run_spec import (
    NODES,
    NOT_IN_KEY,
    WEIGHTS,
    CheckpointFile,
    Dependency,
    RunSpec,
    Seeds,
    labels_key,
)
from rgbt.terminal import info

# Prefixes of the name of an upstream run; a common one keeps its own seed and data set.
PREFIX, COMMON_PREFIX = "experiment:", "common:"

# Setting of an embedded data set: where the generated images are; and of loaders, decoded ones.
CACHE = "cache_dir"
CACHES = (CACHE, "cache")

SEEDS = f"{Seeds.__module__}.{Seeds.__qualname__}"

# Setting that names the folder of another author's code.
CHECKOUT = "model.checkout"

GROUPS = ("dataset", "metric", "prediction", "consistency")
ADDED = "scenes_per_count"  # setting of consistency, by scale
# Settings of a finished run that may be changed: the source of the images and the counting, and
# where code lies.
CHANGEABLE = (
    *GROUPS,
    "data",
    "transform.test_short_edge",
    "trainer.accelerator",
    "trainer.matmul_precision",
    "trainer.threads",
    "trainer.precision",
    CHECKOUT,
)


def _shared_keys() -> Iterator[str]:
    yield from ("seed", "runs_dir", "pretrained")
    for name, node in NODES.items():
        if node.shared is True:
            yield name
    for name, node in NODES.items():
        if not isinstance(node.shared, bool):
            yield from (f"{name}.{key}" for key in node.shared)


# Dotted keys that an upstream run has in common with the run that needs it, beside the sizes of
# the scale. A duration is that of the scale unless it was typed.
SHARED = tuple(_shared_keys())


def _keys_shared_by_common() -> Iterator[str]:
    yield from (key for key in SHARED if key in NOT_IN_KEY)
    for name, node in NODES.items():
        if node.shared is True and name != "dataset":
            yield from (f"{name}.{key}" for key in node.outside_key)


# Dotted keys that a common upstream run takes over from the run that needs it first. None of them
# enters the run key, so that it is one run for all seeds and data sets.
SHARED_BY_COMMON = tuple(_keys_shared_by_common())


def specify(config: DictConfig, overrides: Sequence[str] = ()) -> RunSpec:
    """Make and check the specification of a run.

    Args:
        config: as composed by Hydra.
        overrides: as typed, for the name of the run.

    Raises:
        InputError: an unknown key, a missing value, a value of a wrong type, an upstream
            experiment that does not exist, or a cycle of them.
    """
    return requested_run(config, overrides).check()


def requested_run(config: DictConfig, overrides: Sequence[str] = ()) -> RunSpec:
    """Make a specification without checking it, so that no class of a component is imported.

    Args:
        config: as composed by Hydra.
        overrides: as typed.

    Raises:
        InputError: an unknown key, or upstream runs that do not exist or make a cycle.
    """
    return _requested(config, resolved(config), overrides, ())


def _requested(
    config: DictConfig, plain: dict[str, Any], overrides: Sequence[str], downstream: tuple[str, ...]
) -> RunSpec:
    """Make the run of a configuration with its `plain` values; `downstream` experiments need it."""
    upstream = tuple(_dependencies(config, overrides, (*downstream, config.name)))
    return _spec_of(plain, overrides, upstream)


def _spec_of(
    plain: dict[str, Any], overrides: Sequence[str], upstream: tuple[Dependency, ...]
) -> RunSpec:
    for name in NODES:
        if not isinstance(plain.get(name), dict) or "_target_" not in plain[name]:
            raise InputError(f"'{name}' must be a mapping with `_target_`.")
    check_value("seed", plain["seed"], Seed)
    # Training again is a request to the command, and no property of the run.
    fresh = plain["fresh"] is True
    plain = plain if not fresh else {**plain, "fresh": False}
    return RunSpec(plain=plain, overrides=tuple(overrides), dependencies=upstream, fresh=fresh)


def _dependencies(
    config: DictConfig, overrides: Sequence[str], downstream: tuple[str, ...]
) -> Iterator[Dependency]:
    """Return the upstream runs that a configuration names, each with those upstream of it."""
    for key in (WEIGHTS, labels_key("source"), labels_key("target")):
        reference = parse_reference(key, OmegaConf.select(config, key))
        if reference is None:
            continue
        experiment = reference.experiment
        if experiment in downstream:
            circle = " -> ".join((*downstream, experiment))
            raise InputError(f"{key} makes a cycle of upstream runs: {circle}.")
        typed = [f"+experiment={experiment}", *_shared_overrides(overrides, key, reference)]
        run = _requested(*upstream_config(config, key, reference), typed, downstream)
        if reference.is_common and OmegaConf.select(config, "seeds.start") == "run":
            run = run.with_seed(run.seed + config.seed)
        yield Dependency(key, run, reference.checkpoint, reference.is_common)


class Reference(NamedTuple):
    """An upstream run as a setting names it.

    Attributes:
        experiment: its name.
        checkpoint: the file that is taken: "best.pt" or "last.pt".
        is_common: whether it keeps its own seed and data set.
    """

    experiment: str
    checkpoint: CheckpointFile
    is_common: bool = False


def parse_reference(key: str, value: str | None) -> Reference | None:
    """Parse "experiment:NAME/last.pt" or "common:NAME/last.pt"; None for any other value.

    Raises:
        InputError: the reference is not of this form, there is no such experiment, or the labels
            of a domain are those of a common run, which has other images.
    """
    if value is None or not str(value).startswith((PREFIX, COMMON_PREFIX)):
        return None
    prefix, _, rest = value.partition(":")
    is_common = value.startswith(COMMON_PREFIX)
    name, _, checkpoint = rest.rpartition("/")
    if checkpoint not in get_args(CheckpointFile) or (is_common and key != WEIGHTS):
        raise InputError(
            f"{key}={value}: expected experiment:NAME/best.pt or experiment:NAME/last.pt"
            + (", or the same with common:." if key == WEIGHTS else ".")
        )
    known = available("experiment")
    if name not in known:
        raise InputError(f"{key}={value}: there is no experiment '{name}'; {nearest(name, known)}.")
    return Reference(name, cast(CheckpointFile, checkpoint), is_common)


def upstream_config(
    config: DictConfig, key: str, reference: Reference
) -> tuple[DictConfig, dict[str, Any]]:
    """Return configuration and plain values of an upstream run: its experiment and what both share.

    Shared are `SHARED`, the sizes of the scale and durations that were typed; for weights also the
    network. A common run shares `SHARED_BY_COMMON` instead of `SHARED`. Everything else is the
    experiment's own. Callers do not change it: runs that share the same values have the same one.
    """
    # Its experiment says whether a network has pretrained weights, the scale says all else.
    always = SHARED_BY_COMMON if reference.is_common else SHARED
    shared = [*always, *(f"scale.{size}" for size in config.scale if size != "pretrained")]
    if key == WEIGHTS:
        shared += [
            f"model.{setting}" for setting in config.model if setting not in RUN_SETTINGS["model"]
        ]
    if reference.is_common and CACHE in config.dataset:
        shared.append(f"dataset.{CACHE}")
    values = {path: _as_written(config, path) for path in shared}
    content = pickle.dumps(values)
    return _upstream_config(reference, config.scale.name, content, key == WEIGHTS, own_folders())


def _as_written(config: DictConfig, key: str) -> Any:
    *parents, last = key.split(".")
    mine: Any = OmegaConf.select(config, ".".join(parents)) if parents else config
    node = mine._get_node(last)  # not resolved: a reference is one to the upstream run's own
    return OmegaConf.to_container(node) if OmegaConf.is_config(node) else node._value()


@lru_cache(maxsize=256)
def _upstream_config(
    reference: Reference, scale: str, values: bytes, with_network: bool, own: str
) -> tuple[DictConfig, dict[str, Any]]:
    del own  # of `compose`
    chosen = () if scale == DEFAULT_SCALE else (f"scale={scale}",)
    upstream = compose([f"+experiment={reference.experiment}", *chosen])
    if with_network:
        own_settings = RUN_SETTINGS["model"]
        upstream.model = {setting: upstream.model._get_node(setting) for setting in own_settings}
    for key, value in pickle.loads(values).items():  # noqa: S301 - made above
        if key != f"dataset.{CACHE}" or CACHE in upstream.dataset:
            OmegaConf.update(upstream, key, value, merge=False, force_add=True)
    return upstream, resolved(upstream)


def _shared_overrides(overrides: Sequence[str], key: str, reference: Reference) -> list[str]:
    """Return the typed overrides that the upstream run of the setting `key` shares."""
    always = SHARED_BY_COMMON if reference.is_common else SHARED
    # A file of conf/debug sets sizes of the scale.
    groups = {"scale", "debug", *(node for node in always if node in NODES)}
    groups |= {"model"} if key == WEIGHTS else set()
    own = (WEIGHTS, "model.fresh", "seed", "runs_dir")
    found = []
    for word in overrides:
        path = word.partition("=")[0].lstrip("+").rpartition("@")[2]
        in_group = path.replace("/", ".").split(".")[0] in groups
        if path not in own and (path in always or in_group):
            found.append(word)
    return found


def request_again(settings: Mapping[str, Any], words: Sequence[str]) -> RunSpec:
    """Make the run that today's files request by a stored run's command; none of its words acts.

    A word that chooses a file is composed if a file of ours, or of the user, has that name. A word
    that sets a value only names it: the value is that of the stored settings. Others do nothing.

    Args:
        settings: plain values of its configuration, from which nothing is built.
        words: the overrides of its command.

    Raises:
        InputError, HydraException, OmegaConfBaseException: today's files do not fit together.
    """
    nodes, values = top_level()
    chosen, typed = [], []
    for word in words:
        key, _, name = word.lstrip("+~").partition("=")
        name = name.strip("\"'")
        root = key.replace("/", ".").partition(".")[0]
        if not KEY.fullmatch(key) or root not in (*nodes, *values, "experiment", "debug"):
            continue
        if "." not in key and name in available(key):
            chosen.append(f"+{key}={name}" if word[0] == "+" else f"{key}={name}")
        elif "/" not in key:
            typed.append(key)
    config = compose(chosen)
    for key in typed:
        *parents, last = key.split(".")
        stored: Any = settings
        for name in parents:
            stored = stored.get(name) or {}
        with open_dict(config):
            if last in stored:
                OmegaConf.update(config, key, stored[last], merge=False, force_add=True)
            elif parents and (node := OmegaConf.select(config, ".".join(parents))) is not None:
                node.pop(last, None)
    # The one node that is built on the way to the key.
    if targets(OmegaConf.to_container(config.seeds)) != {"_target_": SEEDS}:
        raise InputError(f"'seeds': expected plain values and the target {SEEDS}.")
    return requested_run(config).with_seed(int(settings["seed"]))


def load_spec(settings: Mapping[str, Any], overrides: Sequence[str] = ()) -> RunSpec:
    """Return the specification of a stored run; its weights and upstream runs are left out.

    Folders of caches, in which files are written, are those of the user or of `overrides`.

    Args:
        settings: plain values of its configuration, whose targets may be built
            (`rgbt.config.stored_config`).
        overrides: of `CHANGEABLE` settings. ``dataset=mfnet`` replaces the whole node by that file
            of ``conf/dataset/``; ``data.eval_batch_size=1`` changes one value.

    Raises:
        InputError: overrides that do not fit.
    """
    register_resolvers()
    typed = {word.partition("=")[0].rpartition(".")[2] for word in overrides}
    config = OmegaConf.create(_without_caches(settings, typed))
    _override(config, overrides)
    config.model.weights = None  # the checkpoint holds them all
    return _spec_of(resolved(config), (), ()).check()


def _without_caches(node: Any, typed: set[str]) -> Any:
    """Return a copy of a stored node, in which our classes get no folder to write into.

    What replaces it is not reported where it was `typed`.
    """
    if isinstance(node, list):
        return [_without_caches(value, typed) for value in node]
    if not isinstance(node, Mapping):
        return node
    copy = {key: _without_caches(value, typed) for key, value in node.items()}
    is_ours = str(node.get("_target_")).startswith("rgbt.")
    for key in CACHES if is_ours else ():
        if copy.get(key) not in (None, "auto"):
            if not {key, "dataset"} & typed:
                info(f"{key}={copy[key]} of the stored configuration is not used; name your own.")
            copy[key] = None
    return copy


def _override(config: DictConfig, overrides: Sequence[str]) -> None:
    """Apply overrides in place: groups first, then single values.

    Absent classes count by the convention of the data set that is measured, unless the run or
    `overrides` set ``metric.absent`` by hand. A partition of a user's own class may lack it.
    ``consistency=views`` adds the counts of as many scenes as the scale of the run does.
    """
    absent = config.metric.get("absent")
    by_hand = absent not in (None, config.dataset.get("absent", "exclude"))
    pairs = [word.lstrip("+").partition("=")[::2] for word in overrides]
    # camera@consistency.view.camera works there. The search path holds for the whole command.
    changes = [(k, v, k.rpartition("@")[2]) for k, v in pairs if k != SEARCH_PATH]
    for key, _, path in changes:
        if not any(path == setting or path.startswith(f"{setting}.") for setting in CHANGEABLE):
            raise InputError(
                f"'{key}' of a finished run cannot be changed; {nearest(key, CHANGEABLE)}."
            )
    groups = [key for key, _, _ in changes if key in GROUPS]
    for group in groups:
        own = [f"{key}={value}" for key, value, path in changes if path.split(".")[0] == group]
        before = config[group]
        config[group] = OmegaConf.to_container(compose(own)[group], resolve=True)
        if group == "consistency" and not any(path.endswith(ADDED) for _, _, path in changes):
            config[group][ADDED] = before.get(ADDED, 1)  # 1: a run before there was a choice
    known = flatten(cast("dict[str, Any]", OmegaConf.to_container(config)))
    for key, value, path in changes:
        if path.split(".")[0] in groups:
            continue
        # A mapping such as dataset.shares is one value, and may be replaced as one.
        if key not in known and not any(other.startswith(f"{key}.") for other in known):
            near = [other for other in known if other.startswith(f"{key.partition('.')[0]}.")]
            raise InputError(f"'{key}' is not a key of this run; {nearest(key, near)}.")
        OmegaConf.update(config, key, parse_yaml(value, key))
    is_typed = "metric.absent" in [path for _, _, path in changes]
    if "absent" in config.metric and not is_typed:
        config.metric.absent = absent if by_hand else config.dataset.get("absent", "exclude")
