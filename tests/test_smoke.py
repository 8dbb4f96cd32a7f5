"""``+debug=smoke``: two steps of an experiment on every data set, of files as well as embedded."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rgbt.config.compose import compose
from rgbt.spec.specify import specify
from tests.commands import SPLITS, Call, assert_one_sentence, only_run
from tests.conftest import write_data
from tests.data.folder_files import PATTERNS, write_folder
from tests.data.freiburg_files import write_freiburg
from tests.data.kp_files import write_kp
from tests.data.pst900_files import write_pst900

OWN = (
    *(f"dataset.{key}='{text}'" for key, text in PATTERNS.items()),
    *("dataset.num_classes=3", "dataset.classes=[background,person,car]"),
    *("dataset.thermal_range=[20000,24000]", "metric.regions=2"),
)
ON_DISK: dict[str, tuple[Callable[[Path], Path], tuple[str, ...]]] = {
    "mfnet": (lambda root: write_data(root, SPLITS, (24, 32)), ()),
    "pst900": (write_pst900, ()),
    "kp": (write_kp, ()),
    "freiburg": (write_freiburg, ("dataset.crop=null",)),
    "folder": (write_folder, OWN),
}


def smoke(call: Call, runs: Path, *words: str) -> tuple[int, str, str]:
    from rgbt.run import main

    place = (f"runs_dir={runs}", "tracking=none", "trainer.accelerator=cpu", "trainer.threads=1")
    return call(main, *words, "+debug=smoke", *place)


@pytest.mark.parametrize("dataset", ON_DISK)
@pytest.mark.slow
def test_files_of_every_data_set(call: Call, tmp_path: Path, dataset: str) -> None:
    write, words = ON_DISK[dataset]
    root = write(tmp_path / "data")
    named = (f"dataset={dataset}", f"dataset.root={root}", *words)
    code, _, err = smoke(call, tmp_path / "runs", "+experiment=grbm", *named)
    assert code == 0, err
    assert only_run(tmp_path / "runs")


@pytest.mark.parametrize("dataset", ["synth", "synth_pst900", "synth_kp", "synth_freiburg"])
@pytest.mark.slow
def test_embedded_data_sets(call: Call, tmp_path: Path, dataset: str) -> None:
    named = (f"dataset={dataset}", f"dataset.cache_dir={tmp_path / 'cache'}")
    code, _, err = smoke(call, tmp_path / "runs", "+experiment=grbm", *named)
    assert code == 0, err


@pytest.mark.slow
def test_the_plus_is_asked_for(call: Call, tmp_path: Path) -> None:
    from rgbt.run import main

    code, _, err = call(main, "+experiment=grbm", "debug=smoke", f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "'debug=smoke' needs a plus: +debug=smoke.")


@pytest.mark.parametrize(
    "dataset", ["mfnet", "pst900", "kp", "freiburg", "synth", "synth_kp", "synth_freiburg"]
)
def test_the_smoke_test_fits_every_data_set(dataset: str) -> None:
    root = [] if dataset.startswith("synth") else ["dataset.root=/data"]
    config = compose(["+experiment=grbm", f"dataset={dataset}", *root, "+debug=smoke"])
    specify(config)
    assert config.trainer.max_steps == 2
    sizes = {key: config.dataset[key] for key in config.dataset if key.startswith("num_tr")}
    assert all(size == 6 for size in sizes.values())
    assert bool(sizes) == dataset.startswith("synth")
