"""Compose the configuration with Hydra, list its files, and register its resolvers.

Nothing of Hydra or OmegaConf is replaced: files are read by a plugin of the kind that Hydra offers
for sources of configurations (`hydra_plugins.rgbt_conf`), which parses each file once while a
command runs and knows several choices in one file. Each choice of files is composed once. Tables
and searches set values on copies of it, which is thirty times faster.
"""

from __future__ import annotations

import os
import pickle
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, cast

import hydra
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest

SEARCH_PATH = "hydra.searchpath"  # names the folders of a user's own files for one command
OWN_FOLDERS = "RGBT_CONF"  # names them for every composition, with commas (conf/config.yaml)

DEFAULT_SCALE = "demo"  # of a run without ``scale=...``

# Scale -> scale whose files it has, where a choice by scale does not name it.
SAME_FILES = {"bench": "demo", "real": "paper"}

VARIANTS = "_variants_"  # choices of a group that differ from their file in a few values

# Hydra's own files, which make a quarter of the files of a composition and of its time. Left out
# where no word names one of them: `composed` returns nothing of the node ``hydra`` but its mode.
WITHOUT_HYDRA = (
    "~hydra/output",
    "~hydra/launcher",
    "~hydra/sweeper",
    "~hydra/help",
    "~hydra/hydra_help",
    "~hydra/hydra_logging",
    "~hydra/job_logging",
    "~hydra/env",
)

PIXELS = re.compile(r"\$\{px:\s*(\d+)\}")


def conf_dir() -> Path:
    """Find the folder of configuration files: inside an installed wheel, or beside the package."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


@contextmanager
def searching(words: Sequence[str]) -> Iterator[None]:
    """Use the search path in the `words` of a command line for all compositions of the command."""
    before = own_folders()
    given = [word.partition("=")[2] for word in words if word.startswith(f"{SEARCH_PATH}=")]
    os.environ[OWN_FOLDERS] = given[0].strip("[]") if given else before
    try:
        yield
    finally:
        os.environ[OWN_FOLDERS] = before


def own_folders() -> str:
    """Return the folders of the user's own files, as they were typed; "": none."""
    return os.environ.get(OWN_FOLDERS, "")


def own_paths() -> list[str]:
    """Return the same folders one by one."""
    typed = (folder.strip().strip("'\"") for folder in own_folders().split(","))
    return [folder for folder in typed if folder]


def compose(overrides: Sequence[str]) -> DictConfig:
    """Compose `rgbt.run`'s configuration, unchecked; HydraException, OmegaConfBaseException."""
    return composed(overrides)[0]


def composed(overrides: Sequence[str]) -> tuple[DictConfig, bool]:
    """Return the same, and whether its files make it a search (``hydra.mode=MULTIRUN``)."""
    files, values = _divided(tuple(overrides))
    try:
        config, is_search = pickle.loads(_by_hydra(files, own_folders()))  # noqa: S301 - made below
        for override in values:  # as Hydra does after it has merged the files
            OmegaConf.update(config, override.key_or_group, override.value())
    except (HydraException, OmegaConfBaseException):  # Hydra names the first wrong word of all
        config, is_search = pickle.loads(_by_hydra(tuple(overrides), own_folders()))  # noqa: S301
    return config, is_search


def compose_hydra(words: Sequence[str]) -> DictConfig:
    """Compose the node ``hydra`` of the configuration, by words such as ``hydra/launcher=ray``."""
    with own_hydra():
        config = hydra.compose("config", list(words), return_hydra_config=True)
    OmegaConf.set_readonly(config.hydra, False)
    return cast("DictConfig", config.hydra)


@lru_cache(maxsize=4096)
def _divided(words: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[Override, ...]]:
    """Return the words that choose files, and the overrides that set values afterwards.

    The order of other words matters (keys that are added or removed, whole nodes): Hydra takes all.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(list(words))
    except HydraException:
        return words, ()
    files, values = [], []
    for word, override in zip(words, parsed, strict=True):
        key = override.key_or_group
        is_value = override.package is None and ("." in key or key in top_level()[1])
        if override.is_sweep_override() or isinstance(override.value(), dict):
            return words, ()
        if not is_value or key.startswith("hydra."):
            files.append(word)
        elif override.type == OverrideType.CHANGE:
            values.append(override)
        else:
            return words, ()
    return tuple(files), tuple(values)


@lru_cache(maxsize=256)
def _by_hydra(words: tuple[str, ...], own: str) -> bytes:
    _check_names(own)
    chosen = words if any("hydra" in word for word in words) else (*words, *WITHOUT_HYDRA)
    with own_hydra():
        config = hydra.compose("config", list(chosen), return_hydra_config=True)
    is_search = config.hydra.mode == RunMode.MULTIRUN
    with open_dict(config):
        del config["hydra"]
    return pickle.dumps((config, is_search))


@cache
def _check_names(_own: str) -> None:
    """Refuse a file of the user that is never read, because rgbt has one of its name."""
    for folder in (path.removeprefix("file://") for path in own_paths()):
        if Path(folder).resolve() == conf_dir().resolve():
            continue
        for file in sorted(Path(folder).rglob("*.yaml")):
            name = file.relative_to(folder)
            if (conf_dir() / name).is_file():
                raise InputError(f"{file}: rgbt has conf/{name}, and uses that; rename yours.")


def variants_of(file: Path) -> dict[str, dict[str, Any] | None]:
    """Return the values of every variant of a file, by the end of its name; {} where it has none.

    A file may hold several choices of its group: ``_variants_: {b0: {...}}`` in cmx.yaml is the
    choice cmx_b0, whose values replace those of the file. Null is the file itself: ``{b2: null}``
    makes it the choice cmx_b2 instead of cmx.
    """
    return _variants(str(file), file.stat().st_mtime_ns)


@lru_cache(maxsize=4096)
def _variants(file: str, _changed: int) -> dict[str, dict[str, Any] | None]:
    text = Path(file).read_text(encoding="utf-8")
    if f"\n{VARIANTS}:" not in text:
        return {}
    plain: Any = OmegaConf.to_container(OmegaConf.create(text))
    return {str(key): values for key, values in plain[VARIANTS].items()}


def choices_in(group: Path) -> set[str]:
    """Return the names of the choices in the folder of a group."""
    files = [file for file in group.glob("*.yaml") if file.is_file()]
    varied = {f"{file.stem}_{variant}" for file in files for variant in variants_of(file)}
    return varied | {file.stem for file in files if None not in variants_of(file).values()}


def place_of(folder: str, name: str) -> tuple[Path, str | None] | None:
    """Return the file of a choice such as "model/cmx_b0", and its variant; None: no such choice."""
    path = Path(folder, name.removesuffix(".yaml"))
    file = path.with_name(f"{path.name}.yaml")
    if file.is_file():
        return None if None in variants_of(file).values() else (file, None)
    words = path.name.split("_")
    for length in range(1, len(words)):
        file = path.with_name("_".join(words[:length]) + ".yaml")
        variant = "_".join(words[length:])
        if file.is_file() and variant in variants_of(file):
            return file, variant
    return None


def parsed(folder: str, provider: str, name: str) -> ConfigResult:
    """Copy a parsed file for Hydra, which changes it: parsing takes half of its time."""
    result: ConfigResult = pickle.loads(_parsed(folder, provider, name))  # noqa: S301 - made below
    return result


@lru_cache(maxsize=4096)
def _parsed(folder: str, provider: str, name: str) -> bytes:
    source, place = FileConfigSource(provider, folder), place_of(folder, name)
    if place is None:  # Hydra's own message
        return pickle.dumps(source.load_config(name))
    result = source.load_config(str(place[0].relative_to(folder)))
    config = cast("DictConfig", result.config)
    config.pop(VARIANTS, None)
    if place[1] is not None:
        config.merge_with(variants_of(place[0])[place[1]] or {})
    return pickle.dumps(result)


def load_choice(name: str) -> dict[str, Any]:
    """Read a choice of ``conf/`` such as "model/cmx_b0" with its defaults, not resolved."""
    result = parsed(str(conf_dir()), "conf", name)
    return cast("dict[str, Any]", OmegaConf.to_container(result.config))


def available(group: str) -> list[str]:
    """List the choices of a group such as "experiment" or "model/inputs", also the user's."""
    return list(_listed(group, ObjectType.CONFIG, own_folders()))


def groups() -> list[str]:
    """Return the names of the groups, also of the user's."""
    return list(_listed("", ObjectType.GROUP, own_folders()))


@cache
def _listed(group: str, kind: ObjectType, _own: str) -> tuple[str, ...]:
    """Keep a list: Hydra needs 20 ms. The search path has `_own` from the environment."""
    with own_hydra():
        return tuple(
            GlobalHydra.instance().config_loader().get_group_options(group, kind, "config")
        )


@cache
def top_level() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the keys of ``conf/config.yaml``: nodes (mappings with `_target_`), plain values."""
    plain: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / "config.yaml"))
    chosen = [key for entry in plain.pop("defaults") if isinstance(entry, dict) for key in entry]
    own = {key: value for key, value in plain.items() if key != "hydra"}
    written = [key for key, value in own.items() if isinstance(value, Mapping)]
    nodes = dict.fromkeys([*(group for group in chosen if " " not in group), *written])
    return tuple(nodes), tuple(key for key in own if key not in nodes)


def resolved(config: DictConfig) -> dict[str, Any]:
    """Return the plain values of a configuration; InputError as of `check_keys`."""
    check_keys(config)
    plain: Any = OmegaConf.to_container(config, resolve=True)
    return cast("dict[str, Any]", plain)


def check_keys(keys: Iterable[Any]) -> None:
    """Refuse a key that ``conf/config.yaml`` does not declare, naming the nearest that it does."""
    nodes, values = top_level()
    known = (*nodes, *values)
    for key in map(str, keys):
        if key not in known:
            raise InputError(f"'{key}' is not a key of the configuration; {nearest(key, known)}.")


@contextmanager
def own_hydra() -> Iterator[None]:
    """Initialise Hydra with our configuration, also inside a command that Hydra runs."""
    register_resolvers()
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
    """Register what configuration files may use; on a node too, before they are read there.

    ``${by_scale:{demo:cmx_tiny,paper:cmx_b2}}``: the entry of the scale, also in a defaults list.
    ``${by_network:{CMX:start_cmx}}``: of the class of the network, with ``_heads`` and ``_rotary``.
    ``${px:64}``: 64 pixels of the paper's images, scaled to the images of the scale.
    ``${scenes:600,6}``: 600 scenes of an embedded data set, or 6 where the scale takes a few.
    ``${first:${.crop_hw}}``: the first entry of a list, which may itself be resolved; null of null.
    ``${embedded:120,null}``: 120 for an embedded data set, null for images of the user.
    """
    resolvers: dict[str, Callable[..., Any]] = {
        "by_scale": _by_scale,
        "by_network": _by_network,
        "px": lambda pixels, *, _root_: round(pixels * float(_root_.scale.pixel_factor)),
        "first": lambda values: None if values is None else values[0],
        "embedded": lambda ours, own, *, _root_: ours if _is_embedded(_root_.dataset) else own,
        "scenes": lambda many, few, *, _root_: few if _root_.scale.get("few_scenes") else many,
    }
    for name, resolve in resolvers.items():
        OmegaConf.register_new_resolver(name, resolve, replace=True)


def _is_embedded(dataset: DictConfig) -> bool:
    return str(dataset.get("_target_")).startswith("rgbt.synth.")


def chosen_scale(scale: str, choices: Iterable[str]) -> str:
    """Return the entry of `choices` for a scale: its own, or of the scale whose files it shares."""
    return scale if scale in choices else SAME_FILES.get(scale, scale)


def _by_scale(choices: dict[str, Any], *, _root_: DictConfig) -> Any:
    scale = _root_.scale  # in a defaults list the name of the file, elsewhere the node
    return choices[chosen_scale(scale if isinstance(scale, str) else scale.name, choices)]


def _by_network(choices: dict[str, Any], *, _root_: DictConfig) -> Any:
    model = _root_.model
    heads = "_heads" if len(model.get("heads", ())) > 1 else ""
    rotary = "_rotary" if model.get("rope_base") else ""
    name = str(model._target_).rpartition(".")[2] + heads + rotary
    if name not in choices:
        raise InputError(f"pretrained: nothing is known for {name}; set a file, or null.")
    return choices[name]


def with_pixels(text: str, factor: float) -> str:
    """Replace every ``${px:...}`` in `text` where images are `factor` times the paper's."""
    return PIXELS.sub(lambda found: str(round(int(found[1]) * factor)), text)


def flatten(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return the leaves of plain values by dotted key, lists as they are."""
    leaves: dict[str, Any] = {}
    for key, value in plain.items():
        inner = flatten(value) if isinstance(value, Mapping) else {"": value}
        leaves |= {f"{key}.{path}" if path else str(key): leaf for path, leaf in inner.items()}
    return leaves
