"""Configuration: where it lies, how it is checked, how a node becomes an object.

The schema of a node is the constructor that its ``_target_`` names: keys and values are checked
against the constructor's signature and annotations before anything is built, so that a misspelt
key in an experiment file or after ``+`` is refused as well (Hydra lets both through).
"""

from __future__ import annotations

import hashlib
import inspect
import json
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest

TOP_LEVEL: dict[str, Any] = {
    **{"seed": int, "name": str, "runs_dir": str, "out": str | None, "pretrained": str | None},
}
"""Keys of the configuration that are plain values; every other one is a node with `_target_`."""

NODES = (
    *("scale", "recipe", "dataset", "domains", "data", "transform", "masker", "model", "loss"),
    *("scheme", "optimizer", "schedule", "trainer", "metric", "consistency", "tracking"),
)

OF_THE_RUN: dict[str, dict[str, Any]] = {
    "model": {"weights": str | None, "fresh": tuple[str, ...]},
}
"""Keys of a node that the run reads itself and the constructor does not take, by node."""

SHARED = (
    *("seed", "runs_dir", "pretrained", "dataset", "data", "metric", "tracking"),
    *(f"trainer.{key}" for key in ("max_steps", "eval_every", "checkpoint_every", "log_every")),
    *(f"trainer.{key}" for key in ("precision", "accelerator", "threads")),
)
"""What an earlier run (`earlier_config`) has in common with the run that needs it, beside the sizes
of the scale. A duration is that of the scale unless it was typed."""

DOMAINS = ("source", "target")

NOT_IN_KEY = (
    *("name", "runs_dir", "out", "scale", "recipe", "tracking", "consistency"),
    *("dataset.root", "dataset.cache_dir", "dataset.palette", "dataset.layout"),
    *("data.num_workers", "data.on_error", "data.eval_batch_size"),
    *("trainer.accelerator", "trainer.threads", "trainer.log_every", "trainer.checkpoint_every"),
)
"""What may differ between two runs that are the same run: labels, paths, hardware, tracking, what
is measured beside, and the sizes of `scale` and `recipe`, which count where others take them up."""

LATER: dict[str, Any] = {
    "trainer.tested": "best",
    "domains": {
        "_target_": "rgbt.data.domains.Domains",
        "source": {
            "_target_": "rgbt.data.domains.Domain",
            **{"split": "train", "view": None, "head": None, "labels": "given"},
            **{"teacher_view": None, "threshold": 0.0, "confidence": False},
        },
        **{"target": None, "target_is": None, "tested_head": "own"},
    },
}
"""Settings that came after runs had been made, with what those did: left out of the key where they
say that, so that a run has the key that it always had."""


def conf_dir() -> Path:
    """The folder of configuration files: inside an installed wheel, or beside the package."""
    here = Path(__file__).resolve().parent
    inside = here / "conf"
    return inside if inside.is_dir() else here.parent / "conf"


def compose(overrides: Sequence[str]) -> DictConfig:
    """The configuration that `rgbt.run` would get from these overrides, not checked."""
    register_resolvers()
    with _own_hydra():
        return hydra.compose("config", list(overrides))


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Hydra with our configuration, also inside a command that Hydra runs."""
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().clear()
        if outer is not None:
            GlobalHydra.instance().initialize(outer)


def register_resolvers() -> None:
    """``${px:64}``: 64 pixels of the paper's images, scaled to the images of the chosen scale."""
    if not OmegaConf.has_resolver("px"):
        OmegaConf.register_new_resolver("px", _scaled_pixels)


def _scaled_pixels(pixels: int, *, _root_: DictConfig) -> int:
    return round(pixels * float(_root_.scale.pixel_factor))


def check(config: DictConfig) -> None:
    """Refuse a configuration with unknown keys, missing values or values of a wrong type.

    Raises:
        InputError: naming the first key that is wrong, with the nearest known name.
    """
    known = [*TOP_LEVEL, *NODES]
    for key in config:
        if key not in known:
            raise InputError(
                f"'{key!s}' is not a key of the configuration; {nearest(str(key), known)}."
            )
    for key, annotation in TOP_LEVEL.items():
        _check_value(key, config[key], annotation)
    for key in NODES:
        check_node(config[key], key)


def check_node(node: DictConfig, path: str) -> None:
    """Check one node against the constructor its ``_target_`` names (see the module docstring).

    Args:
        node: mapping with `_target_`.
        path: its key in the configuration, for messages.

    Raises:
        InputError: missing or unknown target, unknown key, missing value, wrong type.
    """
    _typed(node, path, check_node)


def build(node: DictConfig, **offered: Any) -> Any:
    """The object that a checked node describes.

    Args:
        node: mapping with `_target_`; nested nodes are built first.
        offered: objects from elsewhere (a network for a scheme); those that the constructor names
            are passed beside the node's own values.

    Returns:
        the constructed object; values are converted to the annotated types (lists to tuples).

    Raises:
        InputError: a value that the constructor needs is not in the node.
    """
    path = node._get_full_key(None) or "config"
    target = _target(node, path)
    values = _typed(node, path, lambda child, _: build(child))
    parameters = inspect.signature(target).parameters
    values |= {key: value for key, value in offered.items() if key in parameters}
    needed = [key for key, parameter in parameters.items() if parameter.default is parameter.empty]
    missing = [key for key in needed if key not in values]
    if missing:
        raise InputError(f"'{path}.{missing[0]}' has no value; {node['_target_']} needs it.")
    return target(**values)


def run_key(config: DictConfig) -> str:
    """12 hexadecimal digits that name the run: hash of the resolved configuration.

    Paths, hardware, labels and tracking (`NOT_IN_KEY`) are left out, so that the same method with
    the same seed is the same run wherever it is started from. A file of weights, or a folder of
    pseudo-labels, counts by what is in it, not by where it lies; what is made by an earlier run
    (`rgbt.earlier`) by the key of that run, which need not be there yet.

    Raises:
        InputError: the file of weights or the folder of pseudo-labels is not there.
    """
    plain: dict[str, Any] = {"seed": config.seed}
    if config.model.get("weights") is not None:
        plain["weights"] = [_content("model.weights", config), *config.model.get("fresh", [])]
    plain |= {key: _canonical(config[key], key) for key in NODES}
    for name in DOMAINS:
        if plain["domains"][name] is not None:
            plain["domains"][name]["labels"] = _content(f"domains.{name}.labels", config)
    for dotted in NOT_IN_KEY:
        parent, last = _parent(plain, dotted)
        parent.pop(last, None)
    for dotted, first in LATER.items():
        parent, last = _parent(plain, dotted)
        if parent.get(last) == first:
            del parent[last]
    text = json.dumps(plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _parent(plain: dict[str, Any], dotted: str) -> tuple[dict[str, Any], str]:
    *parents, last = dotted.split(".")
    node: dict[str, Any] = plain
    for parent in parents:
        node = node.get(parent, {})
    return node, last


def _content(key: str, config: DictConfig) -> str:
    """What stands for a file, a folder or an earlier run in the key of a run that reads it."""
    value = str(OmegaConf.select(config, key))
    reference = earlier_run(key, value)
    if reference is not None:
        experiment, checkpoint = reference
        return f"{run_key(earlier_config(config, key, experiment))}/{checkpoint}"
    if key == "model.weights":
        source = weights_file(config)
        assert source is not None, "model.weights has a value"
        with source.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    if value in ("given", "none"):
        return value
    return str(manifest_of(key, value)["digest"])


def manifest_of(key: str, folder: str) -> dict[str, Any]:
    """What a folder of pseudo-labels says of itself.

    Raises:
        InputError: it is not there, or not finished.
    """
    path = Path(folder).expanduser() / "pseudo_labels.json"
    if not path.is_file():
        raise InputError(
            f"{key}={folder}: expected given, none, experiment:NAME/best.pt, or a folder of "
            f"pseudo-labels that is finished, but there is no {path}; write it with "
            "python -m rgbt.predict ... pseudo_labels=true."
        )
    try:
        found = dict(json.loads(path.read_text()))
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error}); remove it and predict again.") from error
    if "digest" not in found:
        raise InputError(f"{path} does not describe pseudo-labels; predict into another folder.")
    return found


def earlier_run(key: str, value: str | None) -> tuple[str, str] | None:
    """Experiment and checkpoint that "experiment:NAME/last.pt" names; None for any other value.

    Raises:
        InputError: it begins so and goes on otherwise, or there is no such experiment.
    """
    if value is None or not value.startswith("experiment:"):
        return None
    name, _, checkpoint = value.removeprefix("experiment:").rpartition("/")
    if checkpoint not in ("best.pt", "last.pt"):
        raise InputError(
            f"{key}={value}: expected experiment:NAME/best.pt or experiment:NAME/last.pt."
        )
    known = [path.stem for path in (conf_dir() / "experiment").glob("*.yaml")]
    if name not in known:
        raise InputError(f"{key}={value}: there is no experiment '{name}'; {nearest(name, known)}.")
    return name, checkpoint


def earlier_config(config: DictConfig, key: str, experiment: str) -> DictConfig:
    """The configuration of an earlier run: its experiment, with what both runs share.

    Shared (`SHARED`) are seed, scale, data set and how it is loaded, durations that were typed,
    device, regions, tracking, and where runs lie; of a run to start from also the network.
    Everything else is the experiment's own.

    Args:
        config: of the run that needs it.
        key: that names it, such as "model.weights".
        experiment: its name.

    Raises:
        InputError: the experiment needs itself.
    """
    if config.name == experiment:
        raise InputError(f"experiment {experiment} names itself as an earlier run.")
    earlier = compose([f"+experiment={experiment}", f"scale={config.scale.name}"])
    # Whether a network has pretrained weights is said by its experiment, all else by the scale.
    shared = [*SHARED, *(f"scale.{each}" for each in config.scale if each != "pretrained")]
    if key == "model.weights":
        shared += [f"model.{each}" for each in config.model if each not in OF_THE_RUN["model"]]
    for each in shared:
        *parents, last = each.split(".")
        mine: Any = OmegaConf.select(config, ".".join(parents)) if parents else config
        node = mine._get_node(last)
        value = OmegaConf.to_container(node) if OmegaConf.is_config(node) else node._value()
        OmegaConf.update(earlier, each, value, merge=False, force_add=True)
    check(earlier)
    return earlier


def weights_file(config: DictConfig) -> Path | None:
    """The file that `model.weights` names; of a run folder its best checkpoint. None: no weights.

    Raises:
        InputError: there is no such file, or an earlier run is not finished.
    """
    named = config.model.get("weights")
    if named is None:
        return None
    reference = earlier_run("model.weights", named)
    if reference is not None:
        experiment, checkpoint = reference
        named = (
            Path(config.runs_dir)
            / run_key(earlier_config(config, "model.weights", experiment))
            / checkpoint
        )
    path = Path(named).expanduser()
    path = path / "best.pt" if path.is_dir() else path
    if not path.is_file():
        raise InputError(
            f"model.weights={named}: there is no file {path}; give a file of weights, or the "
            "folder of a run."
        )
    return path


def _canonical(node: DictConfig, path: str) -> dict[str, Any]:
    """Values as their constructors take them: 4 and 4.0 are one value where both mean 4.0."""
    from pydantic_core import to_jsonable_python

    values = to_jsonable_python(_typed(node, path, _canonical))
    return {"_target_": node["_target_"], **values}


def _typed(node: DictConfig, path: str, nested: Callable[[DictConfig, str], Any]) -> dict[str, Any]:
    """Values of a node as its constructor takes them; `nested` turns a node inside it into one."""
    target = _target(node, path)
    parameters = inspect.signature(target).parameters
    hints = _annotations(target)
    values = {}
    for key, value in _items(node, path):
        if key in OF_THE_RUN.get(path, {}):
            _check_value(f"{path}.{key}", value, OF_THE_RUN[path][key])
            continue
        if key not in parameters:
            known = [*OF_THE_RUN.get(path, ()), *(name for name in parameters if name in hints)]
            raise InputError(
                f"'{path}.{key}' is not a setting of {node['_target_']}; {nearest(key, known)}."
            )
        if isinstance(value, DictConfig) and "_target_" in value:
            values[key] = nested(value, f"{path}.{key}")
        else:
            values[key] = _check_value(f"{path}.{key}", value, hints.get(key, Any))
    return values


def flatten(config: DictConfig) -> dict[str, Any]:
    """Resolved leaves of a configuration by dotted key, lists as they are."""
    plain = OmegaConf.to_container(config, resolve=True)

    def leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
        if not isinstance(value, dict):
            yield path, value
            return
        for key, child in value.items():
            yield from leaves(child, f"{path}.{key}" if path else str(key))

    return dict(leaves(plain, ""))


def _target(node: DictConfig, path: str) -> Any:
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise InputError(
            f"'{path}' must be a mapping with `_target_`; choose a file of conf/{path}/"
        )
    try:
        return get_object(node["_target_"])
    except Exception as error:
        raise InputError(
            f"'{path}._target_': cannot import {node['_target_']} ({error.__cause__ or error})."
        ) from error


def _annotations(target: Any) -> dict[str, Any]:
    function = target.__init__ if inspect.isclass(target) else target
    hints = typing.get_type_hints(function)
    hints.pop("return", None)
    return hints


def _items(node: DictConfig, path: str) -> Iterator[tuple[str, Any]]:
    for key in node:
        if key == "_target_":
            continue
        if OmegaConf.is_missing(node, key):
            raise InputError(f"'{path}.{key!s}' has no value; give one with {path}.{key!s}=...")
        try:
            yield str(key), node[key]
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"'{path}.{key!s}' cannot be resolved: {reason}") from error


def _check_value(path: str, value: Any, annotation: Any) -> Any:
    """`value` as the annotated type; as in JSON, a list may be a tuple and an int a float."""
    import pydantic  # not at the top: --help does not need it

    plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    try:
        return pydantic.TypeAdapter(annotation).validate_json(json.dumps(plain), strict=True)
    except pydantic.errors.PydanticSchemaGenerationError:
        raise InputError(f"'{path}' is not a setting: the run itself provides it.") from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        inner = "".join(f"[{part}]" for part in first["loc"] if isinstance(part, int))
        reason = first["msg"].removeprefix("Value error, ")
        reason = reason[0].lower() + reason[1:]
        raise InputError(f"'{path}'{inner}: {reason}, got {json.dumps(plain)}.") from None
