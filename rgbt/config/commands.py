"""The commands of the lab by name: ``rgbt NAME`` is ``python -m MODULE``."""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple


class Entry(NamedTuple):
    """What ``python -m`` runs, and one line about it."""

    module: str
    about: str


COMMANDS = {
    "run": Entry("rgbt.run", "train one configuration; with -m a grid or a search"),
    "evaluate": Entry("rgbt.evaluate", "scores of a run, or of weights from a file"),
    "predict": Entry("rgbt.predict", "class maps and overlays of images, or pseudo-labels"),
    "consistency": Entry("rgbt.consistency", "temporal consistency (TC, CA) of a run"),
    "robustness": Entry("rgbt.robustness", "scores under missing, noisy, occluded images"),
    "reproduce": Entry("sweeps.reproduce", "run a published table, or one of your own (new)"),
    "study": Entry("sweeps.study", "report of a grid or a search, also while it runs"),
    "report": Entry("analysis.report.__main__", "one page of everything in the MLflow store"),
    "compare": Entry("analysis.compare", "two methods: differences, intervals, p-values"),
    "score": Entry("analysis.score", "scores by region of any method's predictions"),
    "spatial": Entry("analysis.spatial", "what a data set looks like by region"),
    "figures": Entry("analysis.figures.__main__", "draw a figure of the papers"),
    "check": Entry("rgbt.data.check", "read a whole data set and say what is wrong with it"),
    "prepare": Entry(
        "rgbt.data.prepare.__main__", "turn an official download into a data set folder"
    ),
    "cache": Entry("rgbt.data.cache.__main__", "decode a data set once into a cache, or remove it"),
    "weights": Entry("rgbt.weights", "inspect a file of weights, or export those of a run"),
    "sync": Entry("rgbt.tracking.sync", "send run folders to MLflow"),
    "corruptions": Entry("rgbt.corruptions.__main__", "draw the corruptions of one pair of images"),
    "masks": Entry("rgbt.maskers.sketch", "draw examples of a masker"),
    "scenes": Entry("rgbt.data.synth.sheet", "draw scenes of the embedded data set"),
}


def typed_as(main: Callable[..., Any]) -> str:
    """How the command whose function `main` is may be typed: "rgbt evaluate"."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = spec.name if main.__module__ == "__main__" and spec else main.__module__
    names = [name for name, entry in COMMANDS.items() if entry.module == module]
    return f"rgbt {names[0]}" if names else f"python -m {module}"
