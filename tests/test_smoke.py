"""``+debug=smoke``: two steps of an experiment on every data set, embedded or of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rgbt.config.compose import compose
from rgbt.run import main
from rgbt.spec.specify import specify
from tests.commands import SPLITS, Call, only_run
from tests.conftest import write_data
from tests.data.folder_files import PATTERNS, write_folder
from tests.data.freiburg_files import write_freiburg
from tests.data.kp_files import write_kp
from tests.data.pst900_files import write_pst900
from tests.data.video_files import write_mvseg

OWN = (
    *(f"dataset.{key}='{text}'" for key, text in PATTERNS.items()),
    *("dataset.num_classes=3", "dataset.classes=[background,person,car]"),
    *("dataset.thermal_range=[20000,24000]", "metric.regions=2"),
)
ON_DISK: dict[str, tuple[Callable[[Path], Path], tuple[str, ...]]] = {
    "mfnet": (lambda root: write_data(root, SPLITS, (24, 32)), ()),
    "pst900": (write_pst900, ()),
    "kp": (write_kp, ()),
    "freiburg": (write_freiburg, ("dataset.crop=null", "dataset.val_sequences=[seq_04_day]")),
    "folder": (write_folder, OWN),
    "mvseg": (write_mvseg, ()),
}
EMBEDDED = ("synth", "synth_pst900", "synth_kp", "synth_freiburg")


@pytest.mark.slow
@pytest.mark.parametrize("dataset", [*ON_DISK, *EMBEDDED])
def test_smoke_runs_on_every_data_set(call: Call, tmp_path: Path, dataset: str) -> None:
    words = [f"dataset.cache_dir={tmp_path / 'cache'}"]
    if dataset in ON_DISK:
        write, own = ON_DISK[dataset]
        words = [f"dataset.root={write(tmp_path / 'data')}", *own]
    place = (f"runs_dir={tmp_path / 'runs'}", "tracking=none", "trainer.threads=1")
    code, _, err = call(
        *(main, "+experiment=grbm", "+debug=smoke", f"dataset={dataset}", *words, *place),
        "trainer.accelerator=cpu",
    )
    assert code == 0, err
    assert only_run(tmp_path / "runs")


@pytest.mark.parametrize("dataset", ["mfnet", "pst900", "kp", "freiburg", "mvseg", *EMBEDDED])
def test_smoke_fits_every_data_set(dataset: str) -> None:
    root = [] if dataset in EMBEDDED else ["dataset.root=/data"]
    config = compose(["+experiment=grbm", f"dataset={dataset}", *root, "+debug=smoke"])
    specify(config)
    assert config.trainer.max_steps == 2
    sizes = {key: config.dataset[key] for key in config.dataset if key.startswith("num_tr")}
    assert all(size == 6 for size in sizes.values())
    assert bool(sizes) == (dataset in EMBEDDED)
