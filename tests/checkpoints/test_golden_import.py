"""From a file in a released layout, filled by a stated rule, to the recorded class scores.

What the tests of the networks compare tensor by tensor is compared here once more the way a user
gets it: a file, `model.weights`, and the overrides that `inspect` names.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rgbt.checkpoints.load import load_weights
from rgbt.checkpoints.read import read
from rgbt.checkpoints.recognise import recognise
from rgbt.config.component import build
from tests.models import golden

FAST = ("mfnet", "cmx_mit_b0", "temporal_cmx_b2", "cmnext_b0")
SCORES = {"crm": "sem_seg"}
"""Name of the recorded class scores, where it is not "logits"."""


RECORDS = [
    *golden.recorded(r"(?!losses)([a-z]+).*", fast=FAST),
    *golden.recorded(r"([a-z]+).*", fast=FAST, folder="cmnext/"),
]


@pytest.mark.parametrize(("name", "kind"), RECORDS)
def test_scores_of_a_released_file(name: str, kind: str, tmp_path: Path) -> None:
    record = golden.load(name)
    path = tmp_path / "file.pth"
    torch.save({"state_dict": released(record)}, path)
    facts = recognise(read(path))
    overrides = [*facts.fits[0], f"model.num_classes={facts.classes}"]
    net = build(golden.compose(*overrides).model).eval()
    load_weights(net, path)
    with torch.inference_mode():
        logits = net(*record.image).logits
    scores = SCORES.get(kind, "logits")
    found = logits[0] if scores == "sem_seg" else logits
    assert golden.deviation(record, scores, found) <= 1


def released(record: golden.Golden) -> dict[str, torch.Tensor]:
    """Every tensor of the release: filled by the rule, or zeros where the rule leaves it alone."""
    return {
        key: torch.from_numpy(record.fill.fill(key, shape))
        if filled
        else torch.zeros(shape, dtype=getattr(torch, dtype))
        for key, (shape, dtype, filled, _) in record.facts["keys"].items()
    }
