"""Every value of a key is refused in one sentence, or can be used in training."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.component import Component
from rgbt.config.compose import compose

NEVER = (float("nan"), float("inf"), 1e30, -1e30, 10**12, "", "x" * 100_000, "a\x00b", "two\nlines")
"""Values that no setting can mean, whatever it is: one that is accepted is a mistake of ours."""

SOME = (True, -1, 0, 1, 2, 0.5, "x", "Größe ☃", [], [1], [-1, 0], [1.0, 0.5], {}, {"a": 1}, None)
"""Values that some settings can mean."""

MAY_BE_NEGATIVE = (
    *("camera_pitch_deg", "ego_forward_m", "ego_yaw_deg", "source_value", "target_value"),
)

EXPERIMENTS = ("grbm", "cmx", "temporal_con", "heatnet", "sh_max_squares")
"""Together they name most constructors."""


def settings(node: DictConfig, path: str) -> Iterator[tuple[str, Any]]:
    """Every key below a node that holds no mapping of further keys, with its value."""
    for key in node:
        value, name = None if OmegaConf.is_missing(node, key) else node[key], f"{path}.{key}"
        if isinstance(value, DictConfig) and len(value):
            yield from settings(value, name)
        else:
            yield name, OmegaConf.to_object(value) if OmegaConf.is_config(value) else value


def must_be_refused(key: str, usual: Any, value: Any) -> bool:
    """Whether the kind of the usual value says that another one is senseless."""
    if any(value is each for each in NEVER) or key.endswith("_target_"):
        return True
    if value is None or usual is None:
        return False
    if value == -1 and not isinstance(value, bool):
        return key.rpartition(".")[2] not in MAY_BE_NEGATIVE
    same: tuple[tuple[type, ...], ...] = ((bool,), (int, float), (str,), (list,), (dict,))
    kind = next(kinds for kinds in same if isinstance(usual, kinds))
    return not isinstance(value, kind) or isinstance(value, bool) != (bool in kind)


def outcome(config: DictConfig, key: str, value: Any, *, is_senseless: bool) -> str:
    """ "fine", or what is wrong."""
    head, _, rest = key.partition(".")
    plain: Any = OmegaConf.to_container(config[head])
    *parents, last = rest.split(".")
    place = plain
    for parent in parents:
        place = place[parent]
    place[last] = value
    try:
        Component.from_node(OmegaConf.create(plain), head)
    except InputError:
        return "fine"
    except Exception as error:  # what a fuzz is for
        return f"{key}={value!r:.30}: {type(error).__name__}: {str(error)[:200]}"
    return f"{key}={value!r:.30}: senseless value accepted" if is_senseless else "fine"


def test_no_senseless_value_passes_the_check() -> None:
    configs = [compose([f"+experiment={name}", "tracking=none"]) for name in EXPERIMENTS]
    cases = {
        (key, number): (config, usual, value)
        for config in configs
        for node in config
        if OmegaConf.is_dict(config[node]) and "_target_" in config[node]
        for key, usual in settings(config[node], str(node))
        for number, value in enumerate((*NEVER, *SOME))
    }
    wrong = []
    for key, index in random.Random(17).sample([*cases], 200):
        config, usual, value = cases[key, index]
        senseless = must_be_refused(key, usual, value)
        wrong.append(outcome(config, key, value, is_senseless=senseless))
    assert set(wrong) == {"fine"}
