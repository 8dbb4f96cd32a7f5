"""Compose the configuration with Hydra, list its files, and register its resolvers."""

from __future__ import annotations

import gc
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.compose_cache import compose_cached
from rgbt.config.config_source import parse_interpolations_once, parsing_once

SEARCH_PATH = "hydra.searchpath"
"""Override that names the folders of a user's own files for one command."""

OWN_FOLDERS = "RGBT_CONF"
"""Variable that names them for every composition, with commas (read by conf/config.yaml)."""

SAME_FILES = {"bench": "demo"}
"""Scale -> scale whose data sets, networks and other files it has, where a choice by scale does not
name it."""

PIXELS = re.compile(r"\$\{px:\s*(\d+)\}")


def conf_dir() -> Path:
    """The folder of configuration files: inside an installed wheel, or beside the package."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


@contextmanager
def searching(words: Sequence[str]) -> Iterator[None]:
    """Use the search path in the `words` of a command line for all compositions of the command.

    Upstream runs, defaults and groups of a run that is opened again are composed without these
    words, and need the folders of ``hydra.searchpath=...`` too.
    """
    before = own_folders()
    given = [word.partition("=")[2] for word in words if word.startswith(f"{SEARCH_PATH}=")]
    os.environ[OWN_FOLDERS] = given[0].strip("[]") if given else before
    try:
        yield
    finally:
        os.environ[OWN_FOLDERS] = before


def own_folders() -> str:
    """Folders of the user's own files, as they were typed; "": none."""
    return os.environ.get(OWN_FOLDERS, "")


def compose(overrides: Sequence[str]) -> DictConfig:
    """The configuration that `rgbt.run` would compose from these overrides, unchecked."""
    folders = [str(conf_dir()), *filter(None, own_folders().split(","))]
    words = [word for word in overrides if not _is_without_effect(word)]
    return compose_cached(words, top_level()[1], folders, _composed_by_hydra)


def _is_without_effect(word: str) -> bool:
    """Whether an override of Hydra's own node does not change a configuration composed here.

    The node is left out of the result. The folders of ``searching`` are searched in any case.
    """
    key, _, value = word.partition("=")
    return word == "hydra.mode=RUN" or (
        key == SEARCH_PATH and value.strip("[]") == own_folders() != ""
    )


def _composed_by_hydra(words: list[str]) -> DictConfig:
    with own_hydra(), _without_collection():
        return hydra.compose("config", words)


@contextmanager
def _without_collection() -> Iterator[None]:
    """No search for cycles of garbage, which takes a fifth of a composition that leaves few."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def available(group: str) -> list[str]:
    """Names of the files of a group such as "experiment" or "model/inputs", also of the user's."""
    return list(_listed(group, ObjectType.CONFIG, own_folders()))


def groups() -> list[str]:
    """Names of the groups, also of the user's."""
    return list(_listed("", ObjectType.GROUP, own_folders()))


@cache
def _listed(group: str, kind: ObjectType, _own: str) -> tuple[str, ...]:
    """Names in a group; cached, because Hydra needs 20 ms. `_own` is read by conf/config.yaml."""
    with own_hydra():
        loader = GlobalHydra.instance().config_loader()
        return tuple(loader.get_group_options(group, kind, "config"))


def choices(plain: Mapping[str, Any], group: str) -> Iterator[tuple[str, DictConfig]]:
    """The files of a group: name, and the node that each would be in the configuration `plain`."""
    names = available(group)
    composed = _composed_choices(group, plain["scale"]["name"], tuple(names))
    changed = OmegaConf.create(dict(plain))
    for number, name in enumerate(names):
        changed[group] = composed[f"choice_{number}"]
        yield name, changed[group]


@cache
def _composed_choices(group: str, scale: str, names: tuple[str, ...]) -> DictConfig:
    """The files of a group, composed all at once in packages of their own: as fast as one."""
    words = [f"scale={scale}"] if scale in available("scale") else []
    return compose([*words, *(f"+{group}@choice_{n}={name}" for n, name in enumerate(names))])


@cache
def top_level() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Keys that ``conf/config.yaml`` declares: nodes (mappings with `_target_`), plain values."""
    plain: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / "config.yaml"))
    chosen = [key for entry in plain.pop("defaults") if isinstance(entry, dict) for key in entry]
    own = {key: value for key, value in plain.items() if key != "hydra"}
    written = [key for key, value in own.items() if isinstance(value, Mapping)]
    nodes = dict.fromkeys([*(group for group in chosen if " " not in group), *written])
    return tuple(nodes), tuple(key for key in own if key not in nodes)


def check_keys(keys: Iterable[Any]) -> None:
    """Refuse a key that ``conf/config.yaml`` does not declare, naming the nearest that it does."""
    known = [key for each in top_level() for key in each]
    for key in keys:
        if key not in known:
            hint = nearest(str(key), known)
            raise InputError(f"'{key!s}' is not a key of the configuration; {hint}.")


@contextmanager
def own_hydra() -> Iterator[None]:
    """Hydra with our configuration, also inside a command that Hydra runs."""
    register_resolvers()
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        config_dir = str(conf_dir())
        with parsing_once(), hydra.initialize_config_dir(config_dir, version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().clear()
        if outer is not None:
            GlobalHydra.instance().initialize(outer)


def register_resolvers() -> None:
    """Register the resolvers that configuration files may use.

    ``${by_scale:{demo:cmx_tiny,paper:cmx_b2}}``: the entry of the scale, also in a defaults list.
    ``${by_network:{CMX:start_cmx}}``: the entry of the class of the network; with several heads it
    ends with ``_heads``, with rotary positions with ``_rotary``.
    ``${px:64}``: 64 pixels of the paper's images, scaled to the images of the scale.
    ``${scenes:600,6}``: 600 scenes of an embedded data set, or 6 where the scale takes a few.
    """
    parse_interpolations_once()
    for name, resolve in (
        *(("by_scale", _by_scale), ("px", _scaled_pixels), ("scenes", _num_scenes)),
        ("by_network", _by_network),
    ):
        if not OmegaConf.has_resolver(name):
            OmegaConf.register_new_resolver(name, resolve)


def _by_scale(choices: dict[str, Any], *, _root_: DictConfig) -> Any:
    scale = _root_.scale  # in a defaults list the name of the file, elsewhere the node
    name = scale if isinstance(scale, str) else scale.name
    return choices[chosen_scale(name, choices)]


def chosen_scale(scale: str, choices: Iterable[str]) -> str:
    """The entry of `choices` for a scale: its own, or that of the scale whose files it shares."""
    return scale if scale in choices else SAME_FILES.get(scale, scale)


def _by_network(choices: dict[str, Any], *, _root_: DictConfig) -> Any:
    model = _root_.model
    heads = "_heads" if len(model.get("heads", ())) > 1 else ""
    rotary = "_rotary" if model.get("rope_base") else ""
    name = str(model._target_).rpartition(".")[2] + heads + rotary
    if name not in choices:
        raise InputError(
            f"pretrained has no file and no common start for the network {name}; expected one of "
            f"{', '.join(choices)}. Set pretrained=FILE, or pretrained=null to start from random "
            "weights."
        )
    return choices[name]


def _scaled_pixels(pixels: int, *, _root_: DictConfig) -> int:
    return round(pixels * float(_root_.scale.pixel_factor))


def with_pixels(text: str, factor: float) -> str:
    """`text` with the value of every ``${px:...}`` where images are `factor` times the paper's."""
    return PIXELS.sub(lambda found: str(round(int(found[1]) * factor)), text)


def _num_scenes(usually: int, few: int, *, _root_: DictConfig) -> int:
    return few if _root_.scale.get("few_scenes", False) else usually


def flatten(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Leaves of plain values by dotted key, lists as they are."""

    def leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
        if not isinstance(value, Mapping):
            yield path, value
            return
        for key, child in value.items():
            yield from leaves(child, f"{path}.{key}" if path else str(key))

    return dict(leaves(plain, ""))
