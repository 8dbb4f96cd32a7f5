"""Four runs that nothing disturbs, to which those of disturbed sweeps are compared."""

from __future__ import annotations

import fcntl

import pytest

from tests.commands import SPLITS
from tests.conftest import shared_folder, write_data
from tests.sweeps.driven import Sweep


@pytest.fixture(scope="session")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    """Finished runs of this machine, trained once in a call of pytest."""
    place = shared_folder(tmp_path_factory) / "straight"
    place.mkdir(exist_ok=True)
    with (place / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until it is closed
        if not (place / "mf").exists():
            write_data(place / "mf", SPLITS, (48, 64))
        sweep = Sweep(place / "runs", place / "mf", ("hydra.sweeper.workers=2",))
        sweep.finish()
    return sweep
