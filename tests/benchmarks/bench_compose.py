"""Compositions of the rows of all tables: by Hydra alone, and with files and choices kept.

Both compose the same rows in one process, in turns; CPU seconds. The caches are empty at the start
of each turn, as in a new command.

Run: python -m tests.benchmarks.bench_compose
"""

from __future__ import annotations

from contextlib import nullcontext
from unittest.mock import patch

from tests.benchmarks.timing import medians  # isort: skip - before torch

import hydra

from rgbt.config import compose as composing
from rgbt.config import compose_cache, config_source
from sweeps.reproduce import Options, request_of
from sweeps.table.load_table import table_names

ROUNDS = 3
EVERY = 4
"""Of the rows, this one is composed."""


def rows() -> list[list[str]]:
    options = Options(table="all")
    requests = [request_of(name, options, ()) for name in table_names()]
    points = [point for request in requests for point in request.points()]
    return [list(point.overrides) for point in points][::EVERY]


def by_hydra(words: list[list[str]]) -> None:
    with patch.object(composing, "parsing_once", nullcontext):
        for each in words:
            with composing.own_hydra():
                hydra.compose("config", each)


def with_caches(words: list[list[str]]) -> None:
    compose_cache._composed.clear()
    config_source._parsed.clear()
    for each in words:
        composing.compose(each)


def main() -> None:
    words = rows()
    calls = {"Hydra": lambda: by_hydra(words), "cached": lambda: with_caches(words)}
    times = medians(calls, ROUNDS)
    (before, _), (after, _) = times["Hydra"], times["cached"]
    print(f"{len(words)} rows: Hydra {before:.2f} CPU s, cached {after:.2f} CPU s")
    print(f"ratio {before / after:.2f}")


if __name__ == "__main__":
    main()
