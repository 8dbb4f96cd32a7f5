"""The corruption that ``corruption=...`` and ``corruption.KEY=...`` of a command name.

``corruption=NAME`` names a file of ``conf/corruption/``, ``corruption=NAME:IMAGE`` sets its `image`
as well, and ``corruption=my.yaml`` names a file of your own; ``corruption.KEY=...`` changes a
setting, ``corruption.seed=1`` what is drawn.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

from omegaconf import OmegaConf

from rgbt.checks import InputError, check_choice, split_list
from rgbt.config.component import constructor, setting_types
from rgbt.config.compose import conf_dir, flatten
from rgbt.config.stored_config import load_config
from rgbt.config.values import check_value
from rgbt.files.yaml_files import parse_yaml
from rgbt.ranges import Seed

NODE = "corruption"


class ChosenCorruption(NamedTuple):
    """A corruption with its settings, at any severity.

    Attributes:
        name: that all its severities share: "occluded", or "occluded_block-16" if changed.
        node: plain settings with `_target_`, `severities` and the `seed` of all draws.
        changed: keys of settings that the name alone does not tell.
    """

    name: str
    node: dict[str, Any]
    changed: tuple[str, ...] = ()

    @property
    def settings(self) -> dict[str, Any]:
        """Its settings by dotted key, as they are compared: without the ladder of severities."""
        return flatten({NODE: {k: v for k, v in self.node.items() if k != "severities"}})


def row_name(corruption: str) -> str:
    """Return the name of a corruption in files of counts and rows of tables.

    Args:
        corruption: ``NAME`` or ``NAME:IMAGE`` with the image "rgb", "thermal" or "both", such as
            "noise:rgb".

    Returns:
        "noise_rgb"; "noise" of both images; "rgb_removed" and "thermal_removed" of a missing one.
    """
    name, _, image = corruption.partition(":")
    if image in ("", "both"):
        return name
    return f"{image}_{name}" if name == "removed" else f"{name}_{image}"


def corruption_files() -> dict[str, Path]:
    """Name -> file of ``conf/corruption/``."""
    return {path.stem: path for path in sorted((conf_dir() / NODE).glob("*.yaml"))}


def standard_corruptions() -> list[str]:
    """Return every file of ``conf/corruption/`` with each image that its class can corrupt."""
    found = []
    for name, path in corruption_files().items():
        types = setting_types(constructor(load_config(path)["_target_"], NODE))
        images = get_args(types["image"]) if "image" in types else ("both",)
        found += [name if image == "both" else f"{name}:{image}" for image in images]
    return sorted(found, key=row_name)


def choose_corruption(
    name: str, words: Sequence[str] = (), trust: Collection[str] = ()
) -> ChosenCorruption:
    """Return the corruption NAME, NAME:IMAGE or FILE.yaml with ``corruption.KEY=VALUE``.

    `trust` are modules that the file may name (`rgbt.config.stored_config`).
    """
    is_file = name.endswith((".yaml", ".yml"))
    stem, _, image = (name, "", "") if is_file else name.partition(":")
    if not is_file:
        check_choice(NODE, stem, corruption_files())
    path = Path(name).expanduser() if is_file else corruption_files()[stem]
    typed = [*([f"image={image}"] if image else []), *(w.removeprefix(f"{NODE}.") for w in words)]
    stored = load_config(path, trust, NODE)
    config = OmegaConf.create({NODE: stored})
    for key, _, value in (word.partition("=") for word in typed):
        OmegaConf.update(config, f"{NODE}.{key}", parse_yaml(value, f"{NODE}.{key}"))
    # A missing image is refused where the corruption is built.
    node = cast("dict[str, Any]", OmegaConf.to_container(config[NODE], resolve=True))
    node["seed"] = check_value(f"{NODE}.seed", node.get("seed", 0), Seed)
    first = path.stem if is_file else row_name(f"{stem}:{node.get('image', '')}")
    # The image is part of the name of a shipped file, and a change of a user's file.
    unnamed = ("severities", "seed") if is_file else ("severities", "seed", "image")
    changes = []
    for word in typed:
        key = word.partition("=")[0]
        is_changed = OmegaConf.select(config, f"{NODE}.{key}") != OmegaConf.select(stored, key)
        changes += [word] if key not in unnamed and is_changed else []
    drawn = [f"seed={node['seed']}"] if node["seed"] else []
    shown = "_".join(re.sub(r"[^\w.]+", "-", word) for word in (first, *changes, *drawn))
    found = ChosenCorruption(shown, node)
    if is_file:  # files of one name may differ
        digest = hashlib.sha256(json.dumps(found.settings, sort_keys=True).encode()).hexdigest()[:6]
        return ChosenCorruption(f"{shown}-{digest}", node, tuple(found.settings))
    keys = [f"{NODE}.{word.partition('=')[0]}" for word in changes]
    return found._replace(changed=tuple(keys))


def choose_corruptions(
    text: str, words: Sequence[str], trust: Collection[str] = ()
) -> list[ChosenCorruption]:
    """Return the corruptions of ``corruptions=``: names with commas, or "all"; each once."""
    names = standard_corruptions() if text == "all" else split_list(text, "corruptions")
    others = [word for word in words if not word.startswith(f"{NODE}.seed=")]
    if others and len(names) > 1:
        raise InputError(f"'{others[0]}' is a setting of one corruption; corruptions={text}.")
    every = [choose_corruption(name, words, trust) for name in names]
    return list({corruption.name: corruption for corruption in every}.values())


def split_overrides(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Divide overrides into those below ``corruption`` and the others."""
    own = [word for word in overrides if word.startswith(f"{NODE}.")]
    return own, [word for word in overrides if word not in own]
