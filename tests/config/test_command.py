"""Points of a grid in this process and in others, and words that a command refuses."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, RunError
from rgbt.config.command import GridPoint, Main, command
from tests.commands import Call

GRID = ("-m", "hydra/launcher=basic", "hydra/sweeper=basic")


def failing(config: DictConfig, overrides: list[str]) -> int | None:
    """Ends as its seed says, and prints it."""
    print(f"seed {config.seed}: {overrides}")
    if config.seed == 1:
        raise InputError("one is too few.")
    if config.seed == 2:
        raise RunError("two failed.")
    if config.seed == 3:
        raise ZeroDivisionError("three")
    if config.seed == 6:
        from submitit.core.utils import FailedJobError

        raise FailedJobError("job 7 has no output.")
    return 4 if config.seed == 4 else None


entry = command()(failing)


def test_every_point_of_a_grid_here_runs_and_the_highest_code_counts(
    call: Call, tmp_path: Path
) -> None:
    code, out, err = call(entry, *GRID, "seed=2,0,1", f"runs_dir={tmp_path}")
    assert [line for line in out.splitlines() if line.startswith("seed")] == [
        f"seed {seed}: ['seed={seed}', 'runs_dir={tmp_path}']" for seed in (2, 0, 1)
    ]
    assert (code, err) == (2, "rgbt: two failed.\nrgbt: one is too few.\n")
    assert call(entry, *GRID, "seed=0", f"runs_dir={tmp_path}")[0] == 0  # nothing is left of it


@pytest.mark.parametrize(
    ("seed", "kind", "said"),
    [
        (1, InputError, "one is too few."),
        (2, RunError, "two failed."),
        (3, ZeroDivisionError, "three"),
        (4, RunError, "a point ended with code 4."),
    ],
)
def test_point_that_fails_in_another_process_raises(
    seed: int, kind: type[Exception], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RGBT_CONF", "")  # which reading the copy sets
    point = GridPoint(failing)
    codes = point.begin()
    copy = pickle.loads(pickle.dumps(point))
    config = OmegaConf.create({"seed": seed})
    hydra = OmegaConf.create({"overrides": {"task": [f"seed={seed}"]}})
    monkeypatch.setattr(HydraConfig, "get", lambda: hydra)
    with pytest.raises(kind) as caught:
        copy(config)
    assert str(caught.value) == said
    assert codes == []
    assert copy(OmegaConf.create({"seed": 0})) is None


COMPOSE = """\
import json, pickle, sys
from pathlib import Path
point = pickle.loads(Path(sys.argv[1]).read_bytes())
import hydra, omegaconf.base, os
from hydra._internal import defaults_list
used = [omegaconf.base.parse, defaults_list._create_interpolation_map]
print(json.dumps([os.environ["RGBT_CONF"], [function.__module__ for function in used],
    omegaconf.OmegaConf.has_resolver("by_scale"), "torch" in sys.modules]))
"""


def test_point_that_is_read_elsewhere_can_compose_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RGBT_CONF", "/my/conf")
    main: Main = failing
    (tmp_path / "point").write_bytes(pickle.dumps(GridPoint(main)))
    monkeypatch.delenv("RGBT_CONF")
    paths = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", COMPOSE, str(tmp_path / "point")],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    own, modules, has_resolvers, has_torch = json.loads(done.stdout)
    assert (own, has_resolvers, has_torch) == ("/my/conf", True, False)
    # Nothing of the libraries is replaced.
    assert modules == ["omegaconf.grammar_parser", "hydra._internal.defaults_list"]


study = command(sweeper="study")(failing)


@pytest.mark.parametrize("option", [(), ("-r",), ("--run",)])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("hydra/launcher=joblib",), "hydra/launcher=joblib: "),
        (("hydra/launcher=slurm",), "there is no hydra/launcher 'slurm'"),
        (("hydra/launcher=ray", "seed=0,1", "hydra.sweeper.dry_run=true"), "'seed=0,1'"),
        (("hydra/launcher=ray", "trainer.max_stps=1"), "'trainer.max_stps' is not a key"),
        (("hydra/launcher=ray", "hydra.launcher.gpu=1"), "'hydra.launcher.gpu' is not a key"),
        (("hydra/launcher=ray", "hydra.sweeper.waits=false"), "hydra.sweeper.waits"),
        (("hydra/launcher=basic", "hydra.sweeper.wait=false"), "hydra.sweeper.wait"),
    ],
)
def test_launcher_of_one_run_is_checked_as_that_of_several(
    words: tuple[str, ...], said: str, option: tuple[str, ...], call: Call
) -> None:
    code, out, err = call(study, *words, *option)
    assert (code, out, err.count("rgbt: ")) == (2, "", 1)
    assert said in err


def test_launcher_of_one_run_makes_it_a_study_of_one_point(call: Call, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    words = ("hydra/launcher='submitit_local'", "seed=5", "hydra.sweeper.dry_run=true")
    code, out, err = call(study, *words, f"runs_dir={tmp_path}", "tracking=none")
    assert (code, "seed 5" in out) == (0, False), "it is not trained in this process"
    assert "1 of 1 points would be run" in err


def test_basic_launcher_of_one_run_and_one_that_is_only_shown_are_accepted(call: Call) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    assert call(entry, "hydra/launcher=basic")[:2] == (0, "seed 0: []\n")
    code, out, _ = call(entry, "hydra/launcher=submitit_slurm", "--cfg", "hydra", "-p", "hydra")
    assert (code, "SlurmLauncher" in out) == (0, True)


def test_job_that_is_lost_is_one_message(call: Call) -> None:
    pytest.importorskip("submitit")
    assert call(entry, "seed=6")[::2] == (1, "rgbt: job 7 has no output.\n")
