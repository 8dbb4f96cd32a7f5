"""What a chain of day-night runs prints: upstream runs in one line, both heads, means."""

from __future__ import annotations

import json
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import pytest

from rgbt.config.compose import compose
from rgbt.evaluate import entry as evaluate
from rgbt.metrics.counts import Counts
from rgbt.run import main
from rgbt.spec.run_spec import RunSpec
from rgbt.spec.specify import specify
from tests.commands import Call
from tests.data.freiburg_files import write_freiburg


class Chain(NamedTuple):
    """A finished chain of runs.

    Attributes:
        spec: the requested run.
        out: stdout.
        err: stderr.
    """

    spec: RunSpec
    out: str
    err: str


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    """Two stages; the first one needs no teacher, whose training would take most of the time."""
    place = tmp_path_factory.mktemp("chain")
    words = [
        *("+experiment=multi_head_night", "+debug=smoke", "dataset=freiburg", "tracking=none"),
        *(f"dataset.root={write_freiburg(place / 'freiburg')}", "dataset.crop=null"),
        *("scale.critic_width=4", "trainer.accelerator=cpu", "trainer.threads=1"),
        "model.weights=experiment:multi_head_thermal_stage1/last.pt",
        f"runs_dir={place / 'runs'}",
    ]
    out, err = StringIO(), StringIO()
    arguments = patch("sys.argv", ["rgbt", *words])
    with arguments, redirect_stdout(out), redirect_stderr(err), suppress(SystemExit):
        main()
    return Chain(specify(compose(words), words), out.getvalue(), err.getvalue())


def miou(path: Path, night: bool) -> float:
    """The mIoU of day or night by hand in percent; a class without pixels is 0."""
    counts = Counts.load(path)
    assert counts.night is not None
    matrix = counts.counts[np.array(counts.night) == night].sum(axis=(0, 1)).astype(float)
    ious = []
    for k in range(12):
        union = matrix[k].sum() + matrix[:, k].sum() - matrix[k, k]
        ious.append(matrix[k, k] / union if union else 0.0)
    return 100 * float(np.mean(ious))


def value_of(row: str, out: str) -> float:
    (line,) = (each for each in out.splitlines() if each.strip().startswith(f"{row} "))
    return float(line.split()[-1])


def test_upstream_run_is_printed_in_one_line(chain: Chain) -> None:
    (stage,) = chain.spec.upstream
    assert chain.out.count("IoU by region") == 1  # the tables of the requested run alone
    first, second = chain.out.splitlines()[:2]
    assert first.startswith("upstream run debug=smoke ")
    assert " · multi_head_thermal_stage1: mIoU " in first
    assert first.endswith(f"  {stage.folder}")
    assert second.startswith("IoU by region")
    tags = json.loads((stage.folder / "run.json").read_text())["tags"]
    assert tags["rgbt.group"].startswith("multi_head_thermal_stage1 debug=smoke")
    (announced,) = (each for each in chain.err.splitlines() if each.startswith("upstream run "))
    assert announced.endswith(
        " · multi_head_thermal_stage1 for multi_head_night: DeepLabV2, 0.71 M parameters, 2 steps "
        f"of batch 2 (1 epochs), not validated: freiburg has no val, {stage.folder}"
    )
    assert chain.err.count("  device ") == 1


def test_day_night_run_shows_the_mean_and_the_other_head(
    chain: Chain, call: Call, tmp_path: Path
) -> None:
    folder = chain.spec.folder
    day, night = (miou(folder / "counts_test.npz", each) for each in (False, True))
    assert value_of("mean of day and night", chain.out) == pytest.approx(
        (day + night) / 2, abs=0.01
    )
    # As rgbt evaluate predicts the night with the head of the source.
    out = tmp_path / "source.npz"
    code, _, err = call(evaluate, f"run={folder}", "head=source", f"out={out}")
    assert code == 0, err
    other = miou(out, night=True)
    assert other != pytest.approx(night)
    assert value_of("source head, night", chain.out) == pytest.approx(other, abs=0.01)
    stored = Counts.load(folder / "counts_test_source_head.npz")
    assert np.array_equal(stored.counts, Counts.load(out).counts)
    result = json.loads((folder / "result.json").read_text())
    assert 100 * result["test"]["source_head/night/mIoU"] == pytest.approx(other)
