"""``rgbt`` for a reader whose trainings have two steps: ``python -m tests.docs.small WORDS``.

The sizes of a smoke test replace those of the page. The names of groups of runs that an option
names get the words that were added to the run.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

SMOKE = ("+debug=smoke", "trainer.accelerator=cpu", "trainer.threads=1")
ENOUGH = "dataset.num_test=12"
"""Images without which no two methods are compared; of a page that compares."""
SIZES = ("trainer.max_steps", "trainer.eval_every", "trainer.checkpoint_minutes", "+debug")
SIZES += ("scale.max_steps", "scale.eval_every", "scale.batch_size", "data.batch_size")
COMPARING = ("rgbt compare", "rgbt figures", "compare(")
STORE = ("rgbt sync", "rgbt ui", "mlflow", "tracking")
"""Words of a page that reads the MLflow store; elsewhere nothing is sent to it."""


def small(words: list[str], page: str) -> list[str]:
    """The words of a command on a page with this text."""
    name, *rest = words
    is_table = name == "reproduce" and rest[:1] != ["new"]
    if name == "run" or (is_table and "dry_run=true" not in rest):
        rest = [word for word in rest if word.partition("=")[0] not in SIZES]
        is_embedded = all(w.startswith("dataset=synth") for w in rest if w[:8] == "dataset=")
        compares = is_embedded and any(word in page for word in COMPARING)
        rest += [*SMOKE, *([ENOUGH] if compares else [])]
        rest += [] if any(word in page for word in STORE) else ["tracking=none"]
        if any("hydra.sweeper.trials" in word or "+search=" in word for word in rest):
            rest = [word for word in rest if not word.startswith("hydra.sweeper.trials=")]
            rest.append("hydra.sweeper.trials=2")
    if is_table:
        rest = ["seeds=1" if word.startswith("seeds=") else word for word in rest]
    if name in ("compare", "score", "spatial"):
        rest = [word for word in rest if not word.startswith("resamples=")] + ["resamples=100"]
    return [name, *map(_groups, rest)]


def _groups(word: str) -> str:
    """An option that names groups of runs, with their names at these sizes."""
    key, _, value = word.partition("=")
    if key not in ("a", "b", "runs") or not Path("runs").is_dir():
        return word
    from analysis.results import finished_runs
    from rgbt.runs.folder import GROUP

    added = {each.lstrip("+") for each in (*SMOKE, ENOUGH)}
    groups = {run.tags[GROUP] for run in finished_runs() if GROUP in run.tags}
    stored = {" ".join(w for w in each.split(" ") if w not in added): each for each in groups}
    pieces = [piece.rpartition(":") for piece in value.split(",")]
    return f"{key}=" + ",".join(a + b + stored.get(name, name) for a, b, name in pieces)


if __name__ == "__main__":
    given = sys.argv[1:]
    if given and not {"-h", "--help", "--cfg", "--version"} & set(given):
        given = small(given, Path(os.environ["RGBT_PAGE"]).read_text())
    sys.argv = ["rgbt", *given]
    from rgbt.__main__ import main

    sys.exit(main())
