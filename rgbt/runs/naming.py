"""Names and groups of runs: "σ 2 · s1 · grbm", in the group "grbm masker.sigma_div=2".

The group is a tag that all seeds of one configuration share; users type it in commands. The name is
for people: what varies comes first, in words as short as tables and MLflow's lists show whole.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress

from rgbt.checks import InputError
from rgbt.config.compose import flatten
from rgbt.runs.folder import EXPERIMENT, GROUP, SEED, Description, lists_of
from rgbt.runs.run_spec import RunSpec

# Environment variable with more MLflow tags of a run, as JSON; the sweeper names tables in it.
TAGS = "RGBT_TAGS"

# Tag with the keys in which the points of a sweep differ, separated by spaces.
VARIED = "rgbt.varied"

# Characters of a value in a name; a longer one, such as a path, is cut in the middle.
VALUE_LENGTH = 32

# What a setting without a group may have, which says nothing without its key.
VALUES = ("null", "true", "false", "auto", "none")

# Short words for settings, as the papers write them; others are named by the end of their key.
SYMBOLS = {"masker.sigma_div": "σ", "masker.patch_size": "patch", "loss.spatial.alpha": "α"}

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
    points follows the experiment: "σ 2 · s1 · grbm · max_steps 9", and is no parameter: MLflow
    lists every parameter of the runs that it compares, and draws the first one.

    Args:
        spec: the run.
        extra_tags: see `tags_from_environment`.
    """
    settings = {key: str(value) for key, value in flatten(spec.plain).items()}
    # The order is as typed; the last value of a key counts, and a reference by its value.
    words = {}
    for key, equals, value in (word.lstrip("+").partition("=") for word in spec.overrides):
        if key not in SILENT and not key.rpartition("@")[2].startswith(EXTRA_MEASUREMENTS):
            words[key] = f"{key}{equals}{settings.get(key, value) if '${' in value else value}"
    tags = {
        EXPERIMENT: spec.name,
        GROUP: " ".join([spec.name, *words.values()]),
        SEED: str(spec.seed),
        "rgbt.lists": lists_of(settings),
        **(extra_tags or {}),
    }
    # What varies, and what does not; outside of a sweep everything may vary.
    varied = tags.get(VARIED, "").split()
    chosen = {key: word for key, word in words.items() if key in varied or not varied}
    first = [short_word(word) for word in chosen.values()]
    rest = [short_word(word) for key, word in words.items() if key not in chosen]
    seed = f"s{spec.seed}"
    is_method = "experiment" in varied or not first  # the method is what tells the run apart
    named = [spec.name, *first, seed] if is_method else [*first, seed, spec.name]
    values = {key: word.partition("=")[2] for key, word in chosen.items() if "=" in word}
    params = {**values, "name": spec.name, "seed": str(spec.seed)}
    command = [
        word for word in spec.overrides if not word.lstrip("+").startswith(MACHINE_OVERRIDES)
    ]
    return Description(" · ".join([*named, *rest]), tags, params, command)


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


def short_word(word: str) -> str:
    """Return an override as people read it: "masker.sigma_div=1.2227" as "σ 1.22".

    Of a file of a group, "masker=crm", only its name is read. Numbers have three significant
    digits. A long text is cut in its middle, which a digest identifies.
    """
    key, equals, value = word.lstrip("+").partition("=")
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        value = value[1:-1]
    if len(value) > VALUE_LENGTH:
        digest = hashlib.sha256(value.encode()).hexdigest()[:4]
        half = (VALUE_LENGTH - len(digest) - 2) // 2
        value = f"{value[:half]}…{digest}…{value[-half:]}"
    elif "." in value and "_" not in value:  # Python reads 2024_1 and 12e34 as numbers
        with suppress(ValueError):
            value = f"{float(value):.3g}"
    is_choice = value.isidentifier() and "." not in key and value not in VALUES
    if is_choice or not equals:
        return value or key
    return f"{SYMBOLS.get(key, key.rpartition('.')[2])} {value}"
