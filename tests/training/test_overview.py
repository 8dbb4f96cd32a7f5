"""The lines before the first progress bar."""

from __future__ import annotations

import re
from dataclasses import replace as changed
from pathlib import Path

import pytest
import torch

from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.training.overview import announce_network, announce_training, network_line
from tests.composed import specified

WORDS = (
    *("+experiment=mfnet", "dataset.num_train=3", "dataset.num_val=2", "dataset.num_test=4"),
    *("dataset.height=48", "dataset.width=64", "trainer.accelerator=cpu", "data.num_workers=0"),
    *("scale.batch_size=2", "trainer.max_steps=6", "trainer.eval_every=3", "tracking=none"),
)


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> TrainingSetup:
    place = tmp_path_factory.mktemp("overview")
    return set_up_training(specified((*WORDS, f"dataset.cache_dir={place}", f"runs_dir={place}")))


def test_a_training_says_what_it_works_with_and_nothing_that_reads_like_a_remark(
    setup: TrainingSetup, capsys: pytest.CaptureFixture[str]
) -> None:
    announce_training(setup, "seed=0 · mfnet", Path("/runs/abc"))
    out, err = capsys.readouterr()
    name, *lines = err.splitlines()
    shown = {line.split()[0]: " ".join(line.split()[1:]) for line in lines}
    assert (out, name) == ("", "seed=0 · mfnet")
    threads = torch.get_num_threads()
    assert shown["device"] == f"cpu, {threads} thread{'s' * (threads > 1)}, 32-true"
    millions = sum(each.numel() for each in setup.session.model.parameters()) / 1e6
    assert shown["network"] == f"MFNet, {millions:.2f} M parameters"
    assert shown["images"] == "synth: 3 train, 2 val, 4 test"
    assert shown["sizes"] == "stored 48x64, trained 120x160, predicted 120x160"
    # one batch of two of the three images is an epoch
    assert shown["steps"] == "6 of batch 2 (6 epochs), validated every 3"
    assert shown["folder"] == "/runs/abc"
    assert "rgbt: " not in err, "a driver of a sweep takes that for why a run failed"


def test_an_evaluation_says_in_one_line_what_predicts(
    setup: TrainingSetup, capsys: pytest.CaptureFixture[str]
) -> None:
    for step in (240, 0):
        announce_network(changed(setup.session, step=step, label="final.pth"))
    first, second = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"cpu, \d+ threads?, 32-true; .*; checkpoint of step 240", first)
    assert second.endswith("; final.pth")
    assert network_line(setup.session) in first
