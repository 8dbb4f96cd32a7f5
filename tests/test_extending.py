"""Components from outside this repository: a view, and mistakes in the parts of the tutorials."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rgbt import predict
from rgbt.randomness import numpy_generator
from rgbt.run import main
from tests.commands import SPLITS, Call, assert_one_sentence, losses, only_run, short, train
from tests.conftest import write_data
from tests.docs.pages import ROOT, Page, write

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
        rgb, thermal = warp.bilinear(batch.rgb), warp.bilinear(batch.thermal)
        return replace(batch, rgb=rgb, thermal=thermal, label=warp.nearest(batch.label, 255))

    def valid(self, warp):
        return warp.inside()
'''


@pytest.mark.slow
def test_user_second_frame_is_used_in_training(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_views.py").write_text(VIEW)
    (tmp_path / "conf" / "view").mkdir(parents=True)
    own = "_target_: own_views.Aside\ncolumns: 5\n"
    (tmp_path / "conf" / "view" / "aside.yaml").write_text(own)
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


SMOKE = ("+debug=smoke", "tracking=none", "trainer.accelerator=cpu", "trainer.threads=1")


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Writes the files of a page to an empty folder, which is searched for them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("RGBT_CONF", str(tmp_path / "conf"))

    def written(name: str) -> Path:
        for block in Page.read(ROOT / "docs" / name).blocks:
            if block.title:
                write(block, tmp_path)
        return tmp_path

    return written


@pytest.mark.parametrize(
    ("module", "old", "new", "sentence"),
    [
        (
            "masker",
            "height // self.cell",
            "height // 7",
            "masker: Halves returned Tensor (1, 18, 10)",
        ),
        (
            "loss",
            "return {",
            "return costs.mean()\n        return {",
            "loss: Focal returned Tensor ()",
        ),
    ],
)
def test_wrong_part_is_reported(
    lab: Callable[[str], Path], call: Call, module: str, old: str, new: str, sentence: str
) -> None:
    path = lab("tutorials/own-components.md") / f"my_lab/{module}.py"
    text = path.read_text()
    assert old in text, f"docs/tutorials/own-components.md has changed: {old}"
    path.write_text(text.replace(old, new))
    code, _, err = call(main, "+experiment=mfnet_focal", *SMOKE)
    assert code == 2, err
    assert_one_sentence(err, sentence)


def test_data_set_without_new_images_is_reported(lab: Callable[[str], Path], call: Call) -> None:
    folder = lab("how-to/add-other-components.md")
    rng = numpy_generator(0, "arrays")
    for path in (folder / "arrays" / s / n for s in ("train", "val", "test") for n in "ab"):
        path.parent.mkdir(parents=True, exist_ok=True)
        rgb, thermal = (rng.integers(0, 256, (40, 64, *c), np.uint8) for c in ((3,), ()))
        np.savez(path, rgb=rgb, thermal=thermal, label=thermal // 128)
    code, _, err = call(main, "+experiment=mfnet", "dataset=arrays", *SMOKE)
    assert code == 0, err
    words = (f"run={only_run(folder / 'runs')}", "out=out", "trust=my_lab")
    code, _, err = call(predict.entry, *words, f"input={folder}")
    assert code == 2
    assert_one_sentence(err, "Arrays")
