"""Networks of other authors with the commands, on invented checkouts."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rgbt import evaluate, predict
from rgbt.assembly.load_run import open_run
from rgbt.checkpoints.release import save
from rgbt.checks import InputError
from tests.commands import SPLITS, Call, assert_one_sentence, losses, only_run, short, train
from tests.models.external.standins import (
    PAIR,
    STACKED,
    forget,
    own_process,  # noqa: F401 - used by every test
    write_checkout,
)

DROPPING = STACKED.replace(
    "self.conv(x)", "self.conv(nn.functional.dropout(x, 0.3, self.training))"
)
FROZEN = """
class Frozen(Net):
    def forward(self, x):
        return super().forward(x).detach()
"""
FILES = {"model/__init__.py": "", "model/net.py": DROPPING + FROZEN}


def words(checkout: Path, *more: str) -> list[str]:
    return [
        *("+experiment=mfnet", "model=external", f"model.checkout={checkout}"),
        *("masker.patch_size=null", "scale.train_sizes=[48]"),
        *("model.constructor=model.net:Net", "+model.arguments.n_class=${model.num_classes}"),
        *more,
    ]


def test_stored_run_executes_only_a_trusted_checkout(
    call: Call, data: Path, tmp_path: Path
) -> None:
    marked = f"open({str(tmp_path / 'executed')!r}, 'a').write('x')\n{DROPPING}"
    checkout = write_checkout(tmp_path / "code", {**FILES, "model/net.py": marked})
    code, _, err = train(call, data, tmp_path / "runs", *words(checkout, *short(1)))
    assert code == 0, err
    run = only_run(tmp_path / "runs")
    moved = checkout.rename(tmp_path / "moved")
    (tmp_path / "executed").unlink()
    named = (f"run={run}", f"dataset.root={data}", "data.num_workers=0")
    for trust in ((), ("trust=my_lab",), (f"trust={tmp_path / 'other'}",)):
        code, _, err = call(evaluate.entry, *named, *trust)
        assert code == 2
        assert_one_sentence(err, f"add trust={checkout}")
    assert not (tmp_path / "executed").exists()
    forget()
    code, _, err = call(evaluate.entry, *named, f"model.checkout={moved}")
    assert code == 0, err
    moved.rename(checkout)
    forget()
    session = open_run(run, [f"dataset.root={data}"], trust=(str(tmp_path),))
    assert session.model.constructor == "model.net:Net"
    with pytest.raises(InputError, match="trust="):
        open_run(run, [f"dataset.root={data}"])


def test_auxiliary_scores_are_trained_with_their_loss(
    call: Call, data: Path, tmp_path: Path
) -> None:
    checkout = write_checkout(tmp_path / "code", {"model/net.py": PAIR})
    both = ("model.feed=pair", "model.scores=[[0]]", "model.auxiliary=[1]", "loss.weight=1")
    named = words(checkout, *short(1), *both, "loss=cross_entropy_auxiliary")
    code, _, err = train(call, data, tmp_path / "runs", *named)
    assert code == 0, err
    (step,) = losses(only_run(tmp_path / "runs"))
    assert {name for name in step if name.endswith("_aux")}


@pytest.mark.slow
def test_two_frames_are_trained_and_measured(call: Call, data: Path, tmp_path: Path) -> None:
    checkout = write_checkout(tmp_path / "code", FILES)
    temporal = words(checkout, "scheme=temporal_paper", "loss=temporal_paper", "consistency=views")
    code, _, err = train(call, data, tmp_path / "runs", *temporal, *short(1))
    assert code == 0, err
    run = only_run(tmp_path / "runs")
    named = (f"run={run}", f"dataset.root={data}", f"trust={checkout}")
    code, _, err = call(predict.entry, *named, "input=test", f"out={tmp_path / 'maps'}")
    assert code == 0, err
    assert len(list((tmp_path / "maps").rglob("*.png"))) >= len(SPLITS["test"])


def test_trained_weights_are_exported_under_their_authors_names(tmp_path: Path) -> None:
    state = {"network.conv.weight": torch.ones(2), "network.network.bias": torch.zeros(1)}
    save(tmp_path / "author.pth", "released", "external", state, {})
    found = torch.load(tmp_path / "author.pth", weights_only=True)
    assert list(found) == ["conv.weight", "network.bias"]
