"""Names and groups of runs: "masker.sigma_div=2 seed=1 · grbm", in "grbm masker.sigma_div=2".

The group is a tag that all seeds of one configuration share; users type it in commands. The name is
for people: settings that vary come first, then the experiment.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping

from rgbt.checks import InputError
from rgbt.config.compose import flatten
from rgbt.runs.folder import GROUP, Description, lists_of
from rgbt.runs.run_spec import RunSpec

# Environment variable with more MLflow tags of a run, as JSON; the sweeper names tables in it.
TAGS = "RGBT_TAGS"

# Tag with the keys in which the points of a sweep differ, separated by spaces.
VARIED = "rgbt.varied"

# Characters of a value in a name; a longer one, such as a path, is cut in the middle.
VALUE_LENGTH = 32

SILENT = (
    "experiment",
    "search",
    "runs_dir",
    "tracking",
    "dataset.root",
    "model.checkout",
    "name",
    "seed",
    "fresh",
)
# Beginnings of overrides that are of no use on another machine.
MACHINE_OVERRIDES = ("runs_dir=", "tracking", "dataset.root=", "out=", "fresh=", "hydra")

# Beginnings of overrides for extra measurements and trackers, which are not part of the run.
EXTRA_MEASUREMENTS = ("tracking.", "consistency")


def describe(spec: RunSpec, extra_tags: Mapping[str, str] | None = None) -> Description:
    """Name, tags and parameters of a run.

    Only what was typed beside the experiment is named. Of a point of a sweep, what is common to all
    points follows the experiment: "masker.sigma_div=2 seed=1 · grbm trainer.max_steps=9".

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
    # The order is as typed; the last value of a key counts, and a reference by its value.
    words = {}
    for key, equals, value in (word.lstrip("+").partition("=") for word in spec.overrides):
        if key not in SILENT and not key.rpartition("@")[2].startswith(EXTRA_MEASUREMENTS):
            words[key] = f"{key}{equals}{params.get(key, value) if '${' in value else value}"
    tags = {
        "rgbt.experiment": spec.name,
        GROUP: " ".join([spec.name, *words.values()]),
        "rgbt.seed": str(spec.seed),
        "rgbt.lists": lists_of(params),
        **(extra_tags or {}),
    }
    # What varies, a dot, and what does not; outside of a sweep everything may vary.
    varied = tags.get(VARIED, "").split()
    shown = {key: _short(word) for key, word in words.items()}
    first = [word for key, word in shown.items() if key in varied or not varied]
    rest = [word for word in shown.values() if word not in first]
    seed = f"seed={spec.seed}"
    name = f"{' '.join([*first, seed])} · {' '.join([spec.name, *rest])}"
    if "experiment" in varied:
        name = " · ".join(filter(None, (" ".join([spec.name, *first, seed]), " ".join(rest))))
    command = [
        word for word in spec.overrides if not word.lstrip("+").startswith(MACHINE_OVERRIDES)
    ]
    return Description(name, tags, params, command)


def tags_from_environment() -> dict[str, str]:
    """Return the MLflow tags that a sweep gives to the run that it requests (`TAGS`).

    Raises:
        InputError: the variable does not hold a JSON mapping.
    """
    text = os.environ.get(TAGS, "{}")
    try:
        return {str(name): str(value) for name, value in json.loads(text).items()}
    except (json.JSONDecodeError, AttributeError) as error:
        raise InputError(f'{TAGS}={text}: expected JSON such as {{"ticket": "42"}}.') from error


def _short(word: str) -> str:
    """Remove quotes of a word, and cut a long value in its middle, which a digest identifies."""
    key, equals, value = word.partition("=")
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        value = value[1:-1]
    if len(value) > VALUE_LENGTH:
        digest = hashlib.sha256(value.encode()).hexdigest()[:4]
        half = (VALUE_LENGTH - len(digest) - 2) // 2
        value = f"{value[:half]}…{digest}…{value[-half:]}"
    return f"{key}{equals}{value}"
