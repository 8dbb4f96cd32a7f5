"""What the README promises: an own masker, network and experiment from outside this repository."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.commands import SPLITS, Call, assert_one_sentence, only_run, short, train
from tests.conftest import write_data

MODULE = '''
import torch
from torch import nn
from rgbt.types import MaskPair, Output


class Halves:
    """Hides the left half of the thermal image."""

    hides_nothing = False

    def __init__(self, *, cell: int) -> None:
        self.cell = cell

    def __call__(self, image_hw, centre_yx, generator):
        rgb = torch.zeros(len(centre_yx), 2, 2, dtype=torch.bool)
        thermal = rgb.clone()
        thermal[..., 0] = True
        return MaskPair(rgb, thermal)


class Plain(nn.Module):
    """Two convolutions on four channels; hidden cells are set to zero."""

    def __init__(self, *, num_classes: int, width: int = 8) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(4, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, num_classes, 1)
        )

    def forward(self, rgb, thermal, masks=None, *, views=("rgbt",), generator=None):
        if masks is not None:
            size = thermal.shape[-2:]
            hidden = nn.functional.interpolate(masks.thermal[:, None].float(), size=size)
            thermal = thermal * (1 - hidden)
        return Output(self.layers(torch.cat([rgb, thermal], 1)), {})
'''
FILES = {
    "model/plain.yaml": "_target_: my_lab.Plain\nnum_classes: ${dataset.num_classes}\nwidth: 4\n",
    "masker/halves.yaml": "_target_: my_lab.Halves\ncell: 4\n",
    "experiment/mine.yaml": """# @package _global_
defaults:
  - override /model: plain
  - override /masker: halves
  - override /loss: cross_entropy
  - override /scheme: supervised
name: mine
""",
}


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


@pytest.mark.parametrize("hw", [(48, 64), (48, 48)], ids=["3:4", "square"])
@pytest.mark.slow
def test_a_second_frame_of_ones_own_is_trained_on(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hw: tuple[int, int]
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
        *(f"scale.crop_hw=[{hw[0]},{hw[1]}]", *short(1)),
    )
    data = write_data(tmp_path / "mf", SPLITS, hw)
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    (line,) = (
        json.loads(text)
        for text in (only_run(tmp_path / "runs") / "metrics.jsonl").read_text().splitlines()
        if '"train"' in text
    )
    assert 0 < line["values"]["loss/con"] < 1
    code, _, err = train(call, data, tmp_path / "runs", *words, "scheme.view.column=3")
    assert code == 2
    assert_one_sentence(err, "did you mean 'columns'?")


def test_own_parts_run_from_outside_the_repository(
    write_mfnet: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    from rgbt.run import main

    (tmp_path / "my_lab.py").write_text(MODULE)
    for name, text in FILES.items():
        path = tmp_path / "conf" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    names = {"train": ["00001D", "00002N"], "val": ["00003D"], "test": ["00004N"]}
    data = write_mfnet(names, hw=(24, 32))
    monkeypatch.syspath_prepend(str(tmp_path))
    arguments = [
        *("+experiment=mine", "dataset=mfnet", f"dataset.root={data}", "tracking=none"),
        *(f"hydra.searchpath=[file://{tmp_path / 'conf'}]", f"runs_dir={tmp_path / 'runs'}"),
        *("scale.crop_hw=[24,32]", "scale.train_sizes=[24]", "scale.test_short_edge=24"),
        *("scale.batch_size=2", "scale.max_steps=2", "trainer.accelerator=cpu"),
    ]
    monkeypatch.setattr(sys, "argv", ["rgbt", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 0, capfd.readouterr().err
    (result,) = (tmp_path / "runs").glob("*/result.json")
    assert json.loads(result.read_text())["name"].startswith("mine ")

    monkeypatch.setattr(sys, "argv", ["rgbt", *arguments, "model.widht=3"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert "did you mean 'width'?" in capfd.readouterr().err
