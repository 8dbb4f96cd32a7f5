"""More than one machine, on real servers: PostgreSQL for studies, MLflow's server on PostgreSQL."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import optuna
import pytest
from mlflow import MlflowClient

from sweeps.attributes import LABEL, RUNS
from sweeps.run.storage import counted_trials, open_storage
from tests.commands import SMALL, short
from tests.sweeps.fakes import until
from tests.sweeps.servers import mlflow_server, new_database, postgres
from tests.sweeps.run.test_lost_drivers import survive

pytestmark = pytest.mark.slow


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


@pytest.mark.parametrize("kind", ["list", "search"])
@pytest.mark.parametrize("series", range(2))
def test_one_of_two_drivers_killed_on_postgresql(
    database: str, tmp_path: Path, kind: str, series: int
) -> None:
    """Both open a fresh database at once."""
    survive(tmp_path, kind, new_database(database, f"{kind}{series}"), random.Random(series))


def search_command(servers: Servers, data: Path, runs: Path) -> list[str]:
    """A search of two objectives whose trials take seconds; the folder of runs is shared."""
    return [
        *(sys.executable, "-m", "rgbt.run", "-m", "+search=grbm", *SMALL, *short(2)),
        *("dataset=mfnet", f"dataset.root={data}", f"runs_dir={runs}"),
        *("masker.patch_size=32", "tracking=mlflow", f"tracking.uri={servers.mlflow}"),
        *(f"hydra.sweeper.storage={servers.database}", "hydra.sweeper.study=shared-search"),
        *("hydra.sweeper.trials=6", "hydra.sweeper.wait=true"),
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

    def is_noted() -> bool:
        found = "shared-search" in optuna.get_all_study_names(storage)
        trials = (
            optuna.load_study(study_name="shared-search", storage=storage).trials if found else ()
        )
        return sum(t.state.name == "RUNNING" and LABEL in t.user_attrs for t in trials) >= 4

    until(is_noted, "a trial of each driver")
    victim.kill()
    for number, driver in enumerate(drivers):
        code, log = driver.wait(timeout=300), tmp_path / f"driver{number}.log"
        assert code == (-9 if driver is victim else 0), log.read_text()[-3000:]

    trials = optuna.load_study(study_name="shared-search", storage=storage).trials
    counted = counted_trials(optuna.load_study(study_name="shared-search", storage=storage))
    assert [trial.state.name for trial in counted] == ["COMPLETE"] * 6
    assert all(trial.state.is_finished() for trial in trials)
    assert len(trials) > 6, "that of the victim is lost"
    # Every run was finished once, and MLflow knows each of them once.
    keys = [key for trial in counted for key in trial.user_attrs[RUNS]]
    assert len(set(keys)) == 6
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
