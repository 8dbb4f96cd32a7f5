"""More than one machine, on real servers: PostgreSQL for studies, MLflow's server on PostgreSQL."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rgbt.metrics.counts import Counts
from rgbt.tracking.folder import RunFolder
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables
from sweeps.found import Runs
from sweeps.storage import load_study, open_storage
from tests.sweeps.servers import mlflow_server, new_database, postgres

pytestmark = pytest.mark.servers

DRIVERS, TRIALS = 4, 5
WORK = """
import sys, time
from pathlib import Path
import optuna
from sweeps.storage import open_storage
url, gate, own = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
optuna.logging.set_verbosity(optuna.logging.ERROR)
own.touch()
while not gate.exists():
    time.sleep(0.001)
storage = open_storage(url, Path("unused"))
study = optuna.create_study(study_name="shared", storage=storage, load_if_exists=True)
for _ in range(int(sys.argv[4])):
    trial = study.ask()
    x = trial.suggest_float("x", 0, 1)
    trial.set_user_attr("by", own.name)
    study.tell(trial, x)
"""
TABLES = ResultTables(
    split="test",
    step=20,
    region_names=("ring 1", "ring 2"),
    regions=RegionTable("grbm", (0.25, 0.5), 0.4, 156.25),
    classes=ClassTable(("road", "car"), (0.5, 0.3), (0.6, 0.4), ((0.25, 0.75), (0.25, 0.5)), {}),
)


@dataclass(frozen=True)
class Servers:
    """Addresses."""

    database: str
    mlflow: str
    artifacts: Path

    @property
    def password(self) -> str:
        return self.database.partition("rgbt:")[2].partition("@")[0]


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with postgres(tmp_path_factory.mktemp("postgres")) as url:
        yield url


@pytest.fixture(scope="module")
def servers(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Servers]:
    """Two databases of one server, since Optuna and MLflow would share a table's name."""
    artifacts = tmp_path_factory.mktemp("mlflow") / "artifacts"
    with mlflow_server(new_database(database, "mlflow"), artifacts) as url:
        yield Servers(database, url, artifacts)


def finished(folder: RunFolder, dataset: str) -> Counts:
    """What a run leaves."""
    counts = Counts(
        counts=np.arange(8, dtype=np.int32).reshape(1, 2, 2, 2),
        names=("00001D",),
        night=(False,),
        classes=("road", "car"),
        partition="ring2",
        dataset=dataset,
        split="test",
    )
    folder.write_config("seed: 0\n")
    folder.add_provenance({"command": "python -m rgbt.run", "git_commit": "0123456789abcdef"})
    folder.append(20, "test", {"mIoU": 0.4, "Var": 156.25})
    folder.write_tables(TABLES.to_json())
    counts.save(folder.counts_path("test"))
    folder.finish({"dataset": dataset, "test": {"mIoU": 0.4, "Var": 156.25}})
    return counts


def test_four_processes_open_a_fresh_database_at_once(database: str, tmp_path: Path) -> None:
    url, gate = new_database(database, "fresh"), tmp_path / "gate"
    names = [f"driver{index}" for index in range(DRIVERS)]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WORK, url, str(gate), str(tmp_path / name), str(TRIALS)],
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in names
    ]
    while not all((tmp_path / name).exists() for name in names):
        assert all(process.poll() is None for process in processes)
        time.sleep(0.05)
    gate.touch()
    for process in processes:
        _, error = process.communicate(timeout=120)
        assert process.returncode == 0, error
    trials = load_study("shared", open_storage(url, tmp_path)).trials
    assert sorted(trial.number for trial in trials) == list(range(DRIVERS * TRIALS))
    assert {trial.state.name for trial in trials} == {"COMPLETE"}
    by = [trial.user_attrs["by"] for trial in trials]
    assert {name: by.count(name) for name in names} == dict.fromkeys(names, TRIALS)


def test_a_run_of_one_machine_is_found_on_another(servers: Servers, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"

    def tracking(runs_dir: Path) -> MlflowTracking:
        return MlflowTracking(
            servers.mlflow, artifact_uri=None, experiment="rgbt", runs_dir=str(runs_dir)
        )

    folder, tracker = RunFolder(here / "0123456789ab"), tracking(here)
    tracker.start(folder, "grbm seed=0", {"rgbt.key": "0123456789ab"}, {"seed": 0})
    counts = finished(folder, dataset="feed")
    tracker.finish("FINISHED")
    _, this_run = tracker.links()[0]
    assert this_run.startswith(servers.mlflow)
    assert list(servers.artifacts.rglob("counts_test.npz")), "files go through the server"

    runs = Runs(there, tracking(there))
    assert runs.find("0123456789ab", "other data") is None
    found = runs.find("0123456789ab", "feed")
    assert found is not None
    assert found.result == folder.result()
    assert found.scores() == {"test/mIoU": 40.0, "test/Var": 156.25}
    np.testing.assert_array_equal(found.counts().counts, counts.counts)
    assert found.commit == "0123456789"


def test_no_password_is_written_into_a_run(servers: Servers, tmp_path: Path) -> None:
    """Here the store is the database itself, whose address holds one."""
    url = f"{servers.database.rpartition('/')[0]}/mlflow"
    tracker = MlflowTracking(url, artifact_uri=None, experiment="direct", runs_dir=str(tmp_path))
    folder = RunFolder(tmp_path / "run")
    tracker.start(folder, "grbm seed=1", {"rgbt.key": "run"}, {"seed": 1})
    finished(folder, dataset="feed")
    tracker.finish("FINISHED")
    assert tracker.links()[0][0] == "open MLflow"
    for path in tmp_path.rglob("*"):
        assert path.is_dir() or servers.password.encode() not in path.read_bytes(), path
    assert servers.password not in str(tracker.links())


# Searches with several drivers on `database` and `servers`, one of them killed, belong here.
