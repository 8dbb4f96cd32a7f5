"""What to do after a run: paths, and commands that work in the shell of the user as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.config.compose import compose, flatten
from rgbt.config.overrides import composing, words_of_run
from rgbt.config.stored_config import checkouts, shipped_targets, targets
from rgbt.metrics.counts import FEWEST, Counts
from rgbt.runs.folder import GROUP, SEED, RunFolder, counts_name, lists_of
from rgbt.runs.naming import describe
from rgbt.runs.provenance import without_passwords
from rgbt.runs.result import RunResult
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.specify import requested_run
from rgbt.terminal import shell_command
from rgbt.tracking.tracker import Link

# The newest runs, among which one is sought to compare with.
NEWEST = 20

# Beginnings of the words that a run of another method has too, to be trained on the same images.
SHARED = (
    *("dataset", "scale", "recipe", "trainer.", "data.", "seed=", "runs_dir=", "tracking"),
    "debug=",
)

# The method to compare with, and that for the baseline itself.
BASELINE, OTHER = "baseline", "crm"


def next_steps(run: RunSpec, folder: RunFolder) -> list[Link]:
    """Name the picture of test images, and commands to predict and to compare with another method.

    Where no other run of these images is finished, the command that trains one; neither where the
    test images are too few for `rgbt compare`.
    """
    steps, panel = [], folder.path / "figures" / "panel.png"
    if panel.is_file():
        steps.append(("look at", str(panel)))
    # The images of two runs have the same names.
    out = f"out=predicted/{folder.path.name}"
    words = [f"run={folder.path}", "input=test", out, *_trust(run)]
    steps.append(("predict", shell_command("predict", *words)))
    steps.append(("", "your own images: input=FOLDER, with the folders rgb and thermal in it"))
    counts = folder.path / counts_name("test")
    if counts.is_file() and len(Counts.load(counts).names) < FEWEST:
        return steps
    if other := _other_run(run, folder):
        words = [f"a={other}", f"b={folder.path.name}", f"runs_dir={folder.path.parent}"]
        steps.append(("compare", shell_command("compare", *words)))
    elif found := _other_method(run):
        # In a log, a password is not shown: it has to be typed again.
        steps.append(("compare with", shell_command("run", *map(without_passwords, found))))
    return steps


def _trust(run: RunSpec) -> list[str]:
    """Return the word that lets other commands execute the user's own classes; [] without any."""
    own = set(targets(run.plain).values()) - shipped_targets()
    modules = {name.rpartition(".")[0] for name in own}
    folders = {str(Path(path).expanduser().resolve()) for path in checkouts(run.plain).values()}
    return [f"trust={','.join(sorted(modules | folders))}"] if modules | folders else []


def _other_run(run: RunSpec, folder: RunFolder) -> str:
    """Return the key of a finished run of another method on the same images; "": none.

    The newest of the same seed, or else the newest.
    """
    tags, fallback = describe(run).tags, ""
    results = folder.path.parent.glob("*/result.json")
    for result in sorted(results, key=_time_of, reverse=True)[:NEWEST]:
        # A run that is damaged, moved or another user's is none to compare with.
        with suppress(InputError, OSError):
            other = RunResult(result.parent)
            is_of_seed = other.tags.get(SEED) == tags[SEED]
            is_other_method = other.tags.get(GROUP, tags[GROUP]) != tags[GROUP]
            # Settings are read last: a long YAML file each.
            is_wanted = is_other_method and (is_of_seed or not fallback)
            if not is_wanted or not _is_comparable(run.plain, other.settings):
                continue
            if is_of_seed:
                return other.key
            fallback = other.key
    return fallback


def _time_of(path: Path) -> float:
    with suppress(OSError):
        return path.stat().st_mtime
    return 0.0


def _is_comparable(own: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two runs took as many steps, and have the same images."""
    steps = [settings.get("trainer", {}).get("max_steps") for settings in (own, other)]
    return steps[0] == steps[1] and _images(own) == _images(other)


def _images(settings: Mapping[str, Any]) -> tuple[object, ...]:
    """Return what two runs that are compared share: the data set, and the lists of its splits."""
    flat = {key: str(value) for key, value in flatten(settings).items() if key != "dataset.root"}
    return {k: v for k, v in flat.items() if k.startswith("dataset.")}, lists_of(flat)


def _other_method(run: RunSpec) -> Sequence[str]:
    """Return the words of a run of another method on the same images; []: they do not compose."""
    name = OTHER if run.name == BASELINE else BASELINE
    typed = [word for word in run.overrides if word.lstrip("+").startswith(SHARED)]
    words = [f"+experiment={name}", *typed]
    try:
        with composing(words):
            other = requested_run(compose(words), words)
    except InputError:  # settings of a method that is no experiment of ours
        return []
    return words_of_run(words) if _images(other.plain) == _images(run.plain) else []
