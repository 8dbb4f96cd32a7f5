"""Runs of several jobs in one MLflow server."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from mlflow import MlflowClient

from tests.commands import SMALL, short
from tests.sweeps.servers import mlflow_server

pytestmark = pytest.mark.slow


def test_each_run_of_a_grid_is_once_in_a_server(data: Path, tmp_path: Path) -> None:
    runs, backend = tmp_path / "runs", f"sqlite:///{tmp_path / 'mlflow.db'}"
    with mlflow_server(backend, tmp_path / "artifacts") as url:
        command = [
            *(sys.executable, "-m", "rgbt.run", "-m", "+experiment=grbm", *SMALL, *short(2)),
            *("dataset=mfnet", f"dataset.root={data}", f"runs_dir={runs}", "seed=0,1,2"),
            *("masker.patch_size=32", "tracking=mlflow", f"tracking.uri={url}"),
        ]
        for _ in range(2):
            words = [*command, "hydra.sweeper.workers=2"]
            done = subprocess.run(words, capture_output=True, text=True, timeout=300)
            assert done.returncode == 0, done.stderr
        client = MlflowClient(tracking_uri=url)
        experiment = client.get_experiment_by_name("rgbt").experiment_id
        found = client.search_runs([experiment], "attributes.status = 'FINISHED'")
        made = [run.data.tags.get("rgbt.key") for run in found]
    keys = [path.parent.name for path in runs.glob("*/result.json")]
    assert len(keys) == 3
    assert sorted(made) == sorted(keys)
