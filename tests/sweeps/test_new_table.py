from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.checks import InputError
from sweeps.new_table import write_new
from sweeps.plan.table import load_table
from sweeps.reproduce import entry
from tests.commands import Call, assert_one_sentence


def test_one_factor(tmp_path: Path) -> None:
    path = write_new(
        "my/ablation", "grbm", ["masker.sigma_div=1,4,16", "masker.patch_size=32"], tmp_path
    )
    table = load_table("my/ablation", tmp_path)
    assert path == tmp_path / "my" / "ablation.yaml"
    assert [row.label for row in table.rows] == ["sigma_div=1", "sigma_div=4", "sigma_div=16"]
    assert table.rows[1].overrides == ("masker.patch_size=32", "masker.sigma_div=4")
    assert table.rows[1].experiment == "grbm"
    names = [column.name for column in table.columns]
    assert names == ["IoU1", "IoU2", "IoU3", "IoU4", "IoU5", "mIoU", "Var"]
    assert table.columns[-1].best == "lowest"
    assert "rgbt reproduce table=my/ablation" in path.read_text()


def test_two_factors(tmp_path: Path) -> None:
    write_new("two", "grbm", ["masker.sigma_div=1,2", "masker.patch_size='${px:64}',32"], tmp_path)
    labels = [row.label for row in load_table("two", tmp_path).rows]
    assert len(labels) == 4
    assert labels[:2] == ["sigma_div=1 patch_size=64px", "sigma_div=1 patch_size=32"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("grbm", ["masker.sigma_dv=1,2"]), "did you mean 'sigma_div'"),
        (("grbn", ["masker.sigma_div=1,2"]), "did you mean 'grbm'"),
        (("grbm", ["seed=0,1"]), "seed"),
        (("grbm", ["masker.sigma_div=1,2", "runs_dir=/tmp/r"]), "runs_dir"),
        (("grbm", ["masker.sigma_div=1"]), "no key is varied"),
    ],
)
def test_refused(tmp_path: Path, arguments: tuple[str, list[str]], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        write_new("my/bad", *arguments, tmp_path)
    assert not (tmp_path / "my").exists()


def test_the_command_writes_once(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("new", "table=my/ablation", "experiment=grbm", "masker.sigma_div=1,2")
    code, out, _ = call(entry, *words)
    assert (code, "tables/my/ablation.yaml has 2 rows" in out) == (0, True)
    code, _, err = call(entry, *words)
    assert code == 2
    assert_one_sentence(err, "already exists")
