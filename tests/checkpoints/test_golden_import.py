"""From a file in a released layout, filled by a stated rule, to the recorded class scores.

What the tests of the networks compare tensor by tensor is compared here once more the way a user
gets it: a file, `model.weights`, and the overrides that the kind of file names.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rgbt.checkpoints.files import read
from rgbt.checkpoints.load import load_weights, plan_for
from rgbt.config.component import build
from tests.models import golden

FAST = ("mfnet", "cmx_mit_b0")
SCORES = {"crm": "sem_seg"}
"""Name of the recorded class scores, where it is not "logits"."""

NETWORKS = {
    # record: network, names of the file that are left over (an index per block of both branches
    # and the weights of the loss of CRM; a convolution without use; discriminators)
    "crm_swin_t": ("mask2former_swin_t", 25),
    "crm_swin_s": ("mask2former_swin_s", 49),
    "cmx_mit_b0": ("cmx_b0", 0),
    "cmx_mit_b2": ("cmx_b2", 0),
    "temporal_cmx_b2": ("cmx_b2", 2),
    "cmnext/cmnext_b0": ("cmnext_b0", 0),
    "cmnext/cmnext_b2": ("cmnext_b2", 0),
    "cmnext/cmnext_b2_90x122": ("cmnext_b2", 0),
    "rtfnet_50": ("rtfnet_50", 0),
    "mfnet": ("mfnet", 0),
    "heatnet": ("heatnet", 10),
}

RECORDS = [
    *golden.recorded(r"(?!losses)([a-z]+).*", fast=FAST),
    *golden.recorded(r"([a-z]+).*", fast=FAST, folder="cmnext/"),
]


@pytest.mark.parametrize(("name", "kind"), RECORDS)
def test_scores_of_a_released_file(name: str, kind: str, tmp_path: Path) -> None:
    record, (yaml, unused) = golden.load(name), NETWORKS[name]
    words = [f"model={yaml}", f"model.num_classes={13 if yaml == 'heatnet' else 9}"]
    path = tmp_path / "file.pth"
    # Every tensor is filled by the rule, or zeros where the rule leaves it alone.
    tensors = {
        key: torch.from_numpy(record.fill.fill(key, shape))
        if filled
        else torch.zeros(shape, dtype=getattr(torch, dtype))
        for key, (shape, dtype, filled, _) in record.facts["keys"].items()
    }
    torch.save({"state_dict": tensors}, path)
    with torch.device("meta"):
        on_paper = build(golden.compose(*words).model)
    convention = plan_for(on_paper, read(path)).convention
    net = build(golden.compose(*words, *convention).model).eval()
    plan = load_weights(net, path)
    assert (plan.num_set, list(plan.fresh)) == (len(net.state_dict()), [])
    assert len(plan.unused) == unused
    with torch.inference_mode():
        logits = net(*record.image).logits
    scores = SCORES.get(kind, "logits")
    found = logits[0] if scores == "sem_seg" else logits
    assert golden.deviation(record, scores, found) <= 1
