"""Names and groups of runs: settings that vary come first, then the experiment.

The group is a tag that all seeds of one configuration share. Users type it in commands, so its form
is kept: "grbm sigma_div=2". The name is for people: "sigma_div=2 seed=1 · grbm".
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from rgbt.checks import InputError
from rgbt.config.compose import flatten, with_pixels
from rgbt.spec.run_spec import NODES
from rgbt.tracking.run_files import Description

TAGS = "RGBT_TAGS"
"""Environment variable with more MLflow tags of a run, as JSON; the sweeper names tables in it."""

GROUP = "rgbt.group"
"""Tag that the seeds of one configuration share."""

VARIED = "rgbt.varied"
"""Tag with the keys in which the points of a sweep differ, separated by spaces."""

VALUE_LENGTH = 32
"""Characters of a value in a name; a longer one, such as a path, is cut in the middle."""

SILENT = (
    *("experiment", "search", "runs_dir", "tracking", "dataset.root", "model.checkout", "name"),
    *("seed", "fresh"),
)
BESIDE = ("tracking.", "consistency")
"""Extra measurements and trackers are not part of the run."""

OUTSIDE_KEY = tuple(name for name, node in NODES.items() if not node.in_key)
"""Nodes whose keys never make a short key ambiguous: sizes, which the settings of the run repeat,
and what is no part of the run."""


class Named(Protocol):
    """What the name of a run is made of; a `rgbt.spec.run_spec.RunSpec` has it."""

    @property
    def name(self) -> str:
        """Of the experiment."""

    @property
    def seed(self) -> int:
        """Of the run."""

    @property
    def overrides(self) -> Sequence[str]:
        """As typed."""

    @property
    def plain(self) -> Mapping[str, Any]:
        """The whole configuration as resolved values."""


def describe(spec: Named, extra_tags: Mapping[str, str] | None = None) -> Description:
    """Name and group of a run: "sigma_div=2 seed=1 · grbm", in the group "grbm sigma_div=2".

    Only what differs from the experiment is named. Of a point of a sweep, what is common to all
    points follows the experiment: "sigma_div=2 seed=1 · grbm max_steps=9". Keys are cut to
    their last part where only one key of the configuration ends with it.

    Args:
        spec: the run.
        extra_tags: see `tags_from_environment`.
    """
    params = {
        key: str(value)
        for key, value in flatten(spec.plain).items()
        # Paths and passwords of the tracker are no property of the run.
        if not key.endswith("_target_") and not key.startswith("tracking.") and key != "fresh"
    }
    words = _words(spec.overrides, params)
    tags = {
        "rgbt.experiment": spec.name,
        GROUP: " ".join([spec.name, *map(_word, words.values())]),
        "rgbt.seed": str(spec.seed),
        **(extra_tags or {}),
    }
    # What varies, a dot, and what does not; outside of a sweep everything may vary.
    varied = tags.get(VARIED, "").split()
    shown = {key: _word((label, _short(value))) for key, (label, value) in words.items()}
    first = [word for key, word in shown.items() if key in varied or not varied]
    rest = [word for word in shown.values() if word not in first]
    seed = f"seed={spec.seed}"
    name = f"{' '.join([*first, seed])} · {' '.join([spec.name, *rest])}"
    if "experiment" in varied:
        name = " · ".join(filter(None, (" ".join([spec.name, *first, seed]), " ".join(rest))))
    return Description(name, tags, params)


def group_of(tags: Mapping[str, str], params: Mapping[str, str]) -> str:
    """The group of a stored run, written as `describe` writes it now; "" without one.

    Older runs have ``${px:64}`` for its value, and short keys with which several keys end.
    """
    found = []
    for word in tags.get(GROUP, "").split(" "):
        key, equals, value = word.partition("=")
        value = _resolved(value, key, params)
        if equals and "." not in key:
            same = [each for each in _ending(key, params) if params.get(each) == value]
            is_clear = len(_ending(key, params)) < 2 or len(same) != 1 or key in params
            key = key if is_clear else same[0]
        found.append(f"{key}{equals}{value}")
    return " ".join(found)


def _words(overrides: Sequence[str], params: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """What was changed, in typed order: key -> (key as shown, value).

    Of a key that was typed twice the last value counts.
    """
    pairs = dict(item.lstrip("+").partition("=")[::2] for item in overrides)
    changed = {
        key: value
        for key, value in pairs.items()
        if key not in SILENT and not key.rpartition("@")[2].startswith(BESIDE)
    }
    ends = [key.rpartition(".")[2] for key in changed]
    found = {}
    for (key, value), end in zip(changed.items(), ends, strict=True):
        others = _ending(end, params) - {key.rpartition("@")[2]}
        is_clear = ends.count(end) == 1 and end != "seed" and not others and key[0] != "~"
        found[key] = (end if is_clear else key, _resolved(value, key, params))
    return found


def _word(pair: tuple[str, str]) -> str:
    return "=".join(filter(None, pair))  # ~masker.ratio has no value


def _ending(end: str, params: Mapping[str, str]) -> set[str]:
    """Keys of settings and of nodes that end with `end`, but for those that only give sizes."""
    parts = [key.split(".") for key in params if not key.startswith(OUTSIDE_KEY)]
    paths = (".".join(each[: each.index(end) + 1]) for each in parts if end in each)
    return set(paths)


def _resolved(value: str, key: str, params: Mapping[str, str]) -> str:
    """A value as typed, but for references, which are shown as their values."""
    factor = params.get("scale.pixel_factor")
    if factor is not None:
        value = with_pixels(value, float(factor))
    return params.get(key, value) if "${" in value else value


def _short(value: str) -> str:
    """A value without quotes; a long one cut in the middle, and kept distinct by a digest."""
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        value = value[1:-1]
    if len(value) <= VALUE_LENGTH:
        return value
    digest = hashlib.sha256(value.encode()).hexdigest()[:4]
    half = (VALUE_LENGTH - len(digest) - 2) // 2
    return f"{value[:half]}…{digest}…{value[-half:]}"


def tags_from_environment() -> dict[str, str]:
    """The MLflow tags that a sweep gives to the run that it requests (`TAGS`)."""
    text = os.environ.get(TAGS, "{}")
    try:
        tags = json.loads(text)
        if not isinstance(tags, dict):
            raise TypeError("not a mapping")
    except (json.JSONDecodeError, TypeError) as error:
        raise InputError(
            f'{TAGS}={text}: expected JSON such as {{"ticket": "42"}} ({error}).'
        ) from error
    return {str(name): str(value) for name, value in tags.items()}
