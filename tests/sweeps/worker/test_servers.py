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
from mlflow import MlflowClient

from rgbt.metrics.counts import Counts
from rgbt.runs.folder import Description, RunFolder, counts_name, read_result
from rgbt.tables import ClassTable, RegionTable, ResultTables
from rgbt.tracking.mlflow_store import MlflowTracking
from sweeps.attributes import DROPPED, KEY, OWNER, REASON, RUNS
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import load_study, open_storage, study_names
from tests.commands import SMALL, short
from tests.sweeps.servers import mlflow_server, new_database, postgres

pytestmark = pytest.mark.servers

DRIVERS, TRIALS = 4, 5
WORK = """
import sys, time
from pathlib import Path
import optuna
from sweeps.worker.storage import open_storage
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
    folder.write_tables(TABLES)
    counts.save(folder.path / counts_name("test"))
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


def test_run_of_one_machine_is_found_on_another(servers: Servers, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"

    def tracking(runs_dir: Path) -> MlflowTracking:
        return MlflowTracking(
            servers.mlflow, artifact_uri=None, experiment="rgbt", runs_dir=str(runs_dir)
        )

    folder, tracker = RunFolder(here / "0123456789ab"), tracking(here)
    tracker.start(folder, Description("grbm seed=0", {"rgbt.key": "0123456789ab"}, {"seed": "0"}))
    counts = finished(folder, dataset="feed")
    tracker.finish("FINISHED")
    assert tracker.links() == [("open MLflow", f"rgbt ui uri={servers.mlflow}")]
    assert list(servers.artifacts.rglob("counts_test.npz")), "files go through the server"

    runs = RunStore(there, tracking(there))
    assert runs.find("0123456789ab", "other data") is None
    found = runs.find("0123456789ab", "feed")
    assert found is not None
    assert found.result == read_result(folder.path)
    assert found.recorded_scores() == {"test/mIoU": 40.0, "test/Var": 156.25}
    np.testing.assert_array_equal(found.counts().counts, counts.counts)
    assert found.commit == "0123456789"


def test_no_password_is_written_into_a_run(servers: Servers, tmp_path: Path) -> None:
    """Here the store is the database itself, whose address holds one."""
    url = f"{servers.database.rpartition('/')[0]}/mlflow"
    tracker = MlflowTracking(url, artifact_uri=None, experiment="direct", runs_dir=str(tmp_path))
    folder = RunFolder(tmp_path / "run")
    tracker.start(folder, Description("grbm seed=1", {"rgbt.key": "run"}, {"seed": "1"}))
    finished(folder, dataset="feed")
    tracker.finish("FINISHED")
    assert tracker.links()[0][0] == "open MLflow"
    for path in tmp_path.rglob("*"):
        assert path.is_dir() or servers.password.encode() not in path.read_bytes(), path
    assert servers.password not in str(tracker.links())


def search_command(servers: Servers, data: Path, runs: Path) -> list[str]:
    """A search of two objectives whose trials take seconds; the folder of runs is shared."""
    return [
        *(sys.executable, "-m", "rgbt.run", "-m", "+search=grbm", *SMALL, *short(2)),
        *("dataset=mfnet", f"dataset.root={data}", f"runs_dir={runs}"),
        *("masker.patch_size=32", "tracking=mlflow", f"tracking.uri={servers.mlflow}"),
        *(f"hydra.sweeper.storage={servers.database}", "hydra.sweeper.study=shared-search"),
        *("hydra.sweeper.trials=10", "hydra.sweeper.wait=true"),
    ]


def test_search_on_four_drivers_survives_killed_driver(
    servers: Servers, data: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    command = search_command(servers, data, runs)
    drivers = []
    for index in range(4):
        with (tmp_path / f"driver{index}.log").open("w") as log:
            drivers.append(subprocess.Popen(command, stdout=log, stderr=log))
    storage = open_storage(servers.database, tmp_path)
    victim = drivers[2]
    while True:
        assert all(driver.poll() is None for driver in drivers), log_of(tmp_path)
        time.sleep(0.2)
        owners = [
            trial.user_attrs.get(OWNER, "")
            for trial in (load_study("shared-search", storage).trials if names(storage) else ())
            if trial.state.name == "RUNNING" and KEY in trial.user_attrs
        ]
        if any(f":{victim.pid}:" in owner for owner in owners):
            break
    victim.kill()
    for driver in drivers:
        code = driver.wait(timeout=300)
        assert code == (-9 if driver is victim else 0), log_of(tmp_path)

    trials = load_study("shared-search", storage).trials
    counted = [trial for trial in trials if not trial.user_attrs.get(DROPPED)]
    assert len(counted) == 10
    assert {trial.state.name for trial in counted} == {"COMPLETE"}
    assert all(trial.state.is_finished() for trial in trials)
    dropped = [trial for trial in trials if trial.user_attrs.get(DROPPED)]
    assert any("driver had ended" in trial.user_attrs[REASON] for trial in dropped)
    # Every run was finished once, and MLflow knows each of them once.
    keys = [key for trial in counted for key in trial.user_attrs[RUNS]]
    assert len(set(keys)) == 10
    assert {path.parent.name for path in runs.glob("*/result.json")} == set(keys)
    client = MlflowClient(tracking_uri=servers.mlflow)
    found = client.search_runs(
        [client.get_experiment_by_name("rgbt").experiment_id],
        "attributes.status = 'FINISHED' and tags.`rgbt.key` != ''",
        max_results=100,
    )
    made = [run.data.tags["rgbt.key"] for run in found]
    assert sorted(key for key in made if key in keys) == sorted(keys)
    # The addresses that the runs and the reports keep hold no password.
    for path in runs.rglob("*"):
        assert path.is_dir() or servers.password.encode() not in path.read_bytes(), path


def names(storage: object) -> list[str]:
    return [name for name in study_names(storage) if name == "shared-search"]


def log_of(folder: Path) -> str:
    return "\n".join(path.read_text()[-3000:] for path in sorted(folder.glob("driver*.log")))
