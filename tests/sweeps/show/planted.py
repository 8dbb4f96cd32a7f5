"""Finished runs of tables with planted scores, as a driver leaves them."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder, read_description
from rgbt.runs.naming import describe
from sweeps.plan.planner import Planner
from sweeps.plan.request import make_request, row_digests
from tests.analysis.counts import result_of
from tests.measured import remeasured
from tests.sweeps.judge.accuracies import accuracy

PROVENANCE = {
    "started": "2026-01-01T00:00:00+00:00",
    "command": "/home/me/python -m rgbt.run seed=0",
    "git_commit": "0123456789abcdef",
    "git_dirty": False,
    "python": "3.11.7",
    "gpus": [],
    "host": "desk",
    "cpu": "EPYC",
    "cpu_usable": 2,
    "packages": {"torch": "2.0"},
}


def with_rings(counts: Counts) -> Counts:
    """Counts of two regions as those of five rings, of which three have no pixel."""
    empty = np.zeros_like(counts.counts, shape=(len(counts.names), 3, *counts.counts.shape[2:]))
    both = np.concatenate([counts.counts, empty], 1)
    return remeasured(replace(counts, counts=both), partition="ring5")


def set_tag(folder: Path, tag: str, text: str) -> None:
    """Change a tag of a run."""
    known = read_description(folder)
    assert known is not None
    RunFolder(folder).describe(replace(known, tags={**known.tags, tag: text}))


def plant(
    runs_dir: Path,
    name: str,
    shares: Mapping[str, Sequence[float]],
    *extra: str,
    scale: str = "demo",
) -> list[Path]:
    """Runs of rows of a table with these accuracies by seed; `extra` are overrides of every row."""
    request = make_request(name, scale, words=extra)
    planner, folders = Planner((f"runs_dir={runs_dir}",)), []
    request = replace(request, digests=row_digests(request, planner))
    for label, percents in shares.items():
        for seed, percent in enumerate(percents):
            typed = (*planner.base, *request.overrides(label, seed))
            spec = planner.specify(typed, checked=False)
            folder = RunFolder(runs_dir / spec.key)
            folder.describe(describe(spec, request.tags([label])))
            folder.write_config(OmegaConf.to_yaml(OmegaConf.create(dict(spec.plain))))
            folder.add_provenance(PROVENANCE)
            counts = with_rings(accuracy(percent, zlib.crc32(str(seed).encode()) % 97))
            counts = remeasured(counts, dataset="data", run=spec.key)
            counts.save(folder.path / "counts_test.npz")
            result = {"name": spec.name, **result_of(spec.key, counts)}
            folder.finish({**result, "seconds_of_last_process": 60.0 + seed})
            folders.append(folder.path)
    return folders
