from __future__ import annotations

from pathlib import Path

import pytest

from sweeps.plan.table import load_table
from sweeps.reproduce import entry
from tests.commands import Call, assert_one_sentence


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_one_factor_is_written_once(call: Call) -> None:
    words = ("new", "table=my/ablation", "experiment=grbm", "masker.sigma_div=1,4,16")
    code, out, _ = call(entry, *words, "masker.patch_size=32")
    assert (code, "tables/my/ablation.yaml has 3 rows" in out) == (0, True)
    table = load_table("my/ablation")
    assert [row.label for row in table.rows] == ["sigma_div=1", "sigma_div=4", "sigma_div=16"]
    assert table.rows[1].overrides == ("masker.patch_size=32", "masker.sigma_div=4")
    assert table.rows[1].experiment == "grbm"
    names = [column.name for column in table.columns]
    assert names == ["IoU1", "IoU2", "IoU3", "IoU4", "IoU5", "mIoU", "Var"]
    assert table.columns[-1].best == "lowest"
    assert "rgbt reproduce table=my/ablation" in Path("tables/my/ablation.yaml").read_text()
    code, _, err = call(entry, *words)
    assert code == 2
    assert_one_sentence(err, "already exists")


def test_two_factors(call: Call) -> None:
    size = "masker.patch_size='${px:64}',32"
    assert call(entry, "new", "table=two", "experiment=grbm", "masker.sigma_div=1,2", size)[0] == 0
    labels = [row.label for row in load_table("two").rows]
    assert len(labels) == 4
    assert labels[:2] == ["sigma_div=1 patch_size=64px", "sigma_div=1 patch_size=32"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("experiment=grbm masker.sigma_dv=1,2", "did you mean 'sigma_div'"),
        ("experiment=grbn masker.sigma_div=1,2", "did you mean 'grbm'"),
        ("experiment=grbm seed=0,1", "seed"),
        ("experiment=grbm masker.sigma_div=1,2 runs_dir=/tmp/r", "runs_dir"),
        ("experiment=grbm masker.sigma_div=1", "no key is varied"),
    ],
)
def test_refused(call: Call, words: str, sentence: str) -> None:
    code, _, err = call(entry, "new", "table=my/bad", *words.split())
    assert code == 2
    assert_one_sentence(err, sentence)
    assert not Path("tables").exists()
