"""Hydra's composition: where the configuration lies, and what its files may compute."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

PIXELS = re.compile(r"\$\{px:\s*(\d+)\}")


def conf_dir() -> Path:
    """The folder of configuration files: inside an installed wheel, or beside the package."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def compose(overrides: Sequence[str]) -> DictConfig:
    """The configuration that `rgbt.run` would get from these overrides, not checked."""
    register_resolvers()
    with own_hydra():
        return hydra.compose("config", list(overrides))


@contextmanager
def own_hydra() -> Iterator[None]:
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
    """What configuration files may say beside values, by the chosen scale.

    ``${px:64}``: 64 pixels of the paper's images, scaled to the images of the scale.
    ``${scenes:600,6}``: 600 scenes of an embedded data set, or 6 where the scale takes a few.
    """
    for name, resolve in (("px", _scaled_pixels), ("scenes", _num_scenes)):
        if not OmegaConf.has_resolver(name):
            OmegaConf.register_new_resolver(name, resolve)


def _scaled_pixels(pixels: int, *, _root_: DictConfig) -> int:
    return scaled_pixels(pixels, float(_root_.scale.pixel_factor))


def scaled_pixels(pixels: int, factor: float) -> int:
    """Value of ``${px:pixels}`` where images are `factor` times as large as the paper's."""
    return round(pixels * factor)


def with_pixels(text: str, factor: float) -> str:
    """`text` with the value of every ``${px:...}`` in it."""
    return PIXELS.sub(lambda found: str(scaled_pixels(int(found[1]), factor)), text)


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
