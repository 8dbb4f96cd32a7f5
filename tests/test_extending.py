"""A user masker, network and experiment from outside this repository, as documented."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.randomness import numpy_generator
from rgbt.spec.specify import specify
from tests.commands import SPLITS, Call, assert_one_sentence, losses, only_run, short, train
from tests.conftest import write_data

VIEW = '''
from dataclasses import replace

import torch

from rgbt.geometry.warp import Warp


class Aside:
    """The second frame lies a few whole columns to the right; no camera is needed."""

    def __init__(self, *, columns: int) -> None:
        self.columns = columns

    def draw(self, count, generator):
        return torch.randint(1, self.columns + 1, (count, 1), generator=generator)

    def warp(self, angles, image_hw):
        turn = torch.eye(3, dtype=torch.float64).repeat(len(angles), 1, 1)
        turn[:, 0, 2] = -angles[:, 0]
        edges = torch.tensor([-0.5, -0.5, image_hw[1] - 0.5, image_hw[0] - 0.5]).double()
        return Warp(turn, edges.expand(len(angles), 4), image_hw, "once")

    def batch(self, batch, warp):
        return replace(
            batch,
            rgb=warp.bilinear(batch.rgb),
            thermal=warp.bilinear(batch.thermal),
            label=warp.nearest(batch.label, 255),
        )

    def valid(self, warp):
        return warp.inside()
'''


@pytest.mark.slow
def test_user_second_frame_is_used_in_training(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_views.py").write_text(VIEW)
    (tmp_path / "conf" / "view").mkdir(parents=True)
    (tmp_path / "conf" / "view" / "aside.yaml").write_text(
        "_target_: own_views.Aside\ncolumns: 5\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    words = (
        *("+experiment=temporal_con", "view@scheme.view=aside", "consistency=none"),
        *(f"hydra.searchpath=[file://{tmp_path / 'conf'}]", "masker.patch_size=null"),
        *("scale.crop_hw=[48,48]", *short(1)),
    )
    data = write_data(tmp_path / "mf", SPLITS, (48, 48))
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    (step,) = losses(only_run(tmp_path / "runs"))
    assert 0 < step["loss/con"] < 1
    code, _, err = train(call, data, tmp_path / "runs", *words, "scheme.view.column=3")
    assert code == 2
    assert_one_sentence(err, "did you mean 'columns'?")


PAGE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"


def written(root: Path) -> Path:
    """The files of the page, by the name in the first line of each block, and some data."""
    for text in re.findall(r"```(?:python|yaml)\n(.*?)```", PAGE.read_text(), re.DOTALL):
        name, _, body = text.removeprefix("# ").partition("\n")
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(body)
    rng = numpy_generator(0, "arrays")
    for split in ("train", "val", "test"):
        (root / "data" / split).mkdir(parents=True)
        for name in "ab":
            rgb = rng.integers(0, 256, (40, 64, 3), np.uint8)
            thermal, label = rng.integers(0, 256, (40, 64), np.uint8), np.zeros((40, 64), np.uint8)
            label[:20] = 2
            np.savez(root / "data" / split / name, rgb=rgb, thermal=thermal, label=label)
    return root


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with what the page says, on Python's path."""
    monkeypatch.syspath_prepend(str(tmp_path))
    yield written(tmp_path)
    sys.modules.pop("my_lab", None)


def words_of(lab: Path) -> list[str]:
    return [
        *("+experiment=mine", "+debug=smoke", f"dataset.root={lab / 'data'}"),
        *(f"hydra.searchpath=[file://{lab / 'conf'}]", f"runs_dir={lab / 'runs'}"),
        *("tracking=none", "trainer.accelerator=cpu", "trainer.threads=1"),
    ]


def test_the_page_runs(lab: Path, call: Call) -> None:
    from rgbt import evaluate, predict
    from rgbt.maskers import sketch
    from rgbt.run import main

    code, _, err = call(main, *words_of(lab))
    assert code == 0, err
    run = only_run(lab / "runs")
    assert json.loads((run / "result.json").read_text())["name"].endswith(" · mine")
    assert {"loss/clean_focal", "loss/masked_focal"} <= losses(run)[0].keys()
    code, _, err = call(sketch.main, *words_of(lab), f"out={lab / 'masks.png'}")
    assert code == 0, err
    assert (lab / "masks.png").is_file()
    words = (f"run={run}", f"corruption={lab / 'haze.yaml'}", "severity=0.5", "trust=my_lab")
    code, _, err = call(evaluate.entry, *words)
    assert code == 0, err
    words = (f"run={run}", "input=test", f"out={lab / 'out'}", "trust=my_lab")
    code, _, err = call(predict.entry, *words)
    assert code == 0, err
    code, _, err = call(predict.entry, *words, f"input={lab}")
    assert code == 2
    assert_one_sentence(
        err, "Arrays does not declare how to read new images. Name one of its splits"
    )


FOCAL = '{"focal": ((1 - (-each).exp()) ** self.gamma * each).mean()[None]}'


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "height // self.cell",
            "height // 7",
            "masker: Halves.__call__ returned MaskPair: rgb is Tensor (1, 9, 2) bool; expected "
            "MaskPair(rgb, thermal), each bool (1, h, w), True = hidden, h and w dividing 64 and "
            "64: a crop of 40x64 pixels is padded to 64x64 before cells are cut.",
        ),
        (FOCAL, "each.mean()", "loss: Focal.__call__ returned Tensor () float32; expected a dict"),
    ],
)
def test_a_wrong_part_is_one_sentence_of_the_command(
    lab: Path, call: Call, old: str, new: str, sentence: str
) -> None:
    from rgbt.run import main

    text = (lab / "my_lab.py").read_text()
    assert old in text
    (lab / "my_lab.py").write_text(text.replace(old, new))
    code, _, err = call(main, *words_of(lab))
    assert code == 2, err
    assert_one_sentence(err, sentence)


def test_misspelt_key_of_a_user_file_is_named(lab: Path) -> None:
    config = compose([*words_of(lab), "masker.cell=4", "+masker.cel=4"])
    with pytest.raises(InputError, match=r"'masker.cel' is not a setting of my_lab.Halves; did"):
        specify(config)
