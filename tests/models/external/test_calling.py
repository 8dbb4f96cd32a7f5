"""Forms of feeding, and scores inside outputs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt.checks import InputError
from rgbt.models.external.calling import edge_map, picked, scores_at, structure
from tests.models.external.standins import HEAD, PAIR, STACKED, external, images, write_checkout

LIST = PAIR.replace("def forward(self, rgb, thermal):", "def forward(self, x):").replace(
    "both = torch.cat([rgb, thermal[:, :1]], 1)", "both = torch.cat([x[0], x[1][:, :1]], 1)"
)
DICTS = f"""{HEAD}
class Net(Base):
    def forward(self, batched):
        return [{{"sem_seg": self.conv(each["image"])}} for each in batched]
"""
THERMAL = STACKED.replace("channels=4", "channels=1")
EDGES = f"""{HEAD}
class Net(Base):
    def forward(self, rgb, thermal, label):
        assert label.shape == (len(rgb), *rgb.shape[2:])
        return self.conv(torch.cat([rgb, label[:, None] / 255], 1))
"""
TWO = ((0,),)


@pytest.mark.parametrize(
    ("code", "changes", "inputs"),
    [
        (STACKED, {}, "unit"),
        (STACKED.replace("channels=4", "channels=6"), {}, "unit_three"),
        (PAIR, {"feed": "pair", "scores": TWO}, "unit"),
        (PAIR, {"feed": "pair", "scores": TWO}, "imagenet_449"),
        (LIST, {"feed": "list", "scores": TWO}, "imagenet_unit"),
        (DICTS, {"feed": "dicts", "scores": (("*", "sem_seg"),)}, "crm"),
        (THERMAL, {"feed": "thermal"}, "unit"),
        (EDGES, {"feed": "pair_and_edges"}, "unit_three"),
    ],
)
def test_every_form_is_fed_with_normalised_images(
    tmp_path: Path, code: str, changes: dict[str, Any], inputs: str
) -> None:
    net = external(write_checkout(tmp_path, {"model/net.py": code}), inputs=inputs, **changes)
    rgb, thermal = images()
    shown = net.inputs(rgb, thermal)
    seen = {
        "thermal": [shown.thermal],
        "pair_and_edges": [shown.rgb, edge_map(rgb, thermal)[:, None] / 255],
    }.get(net.feed, [shown.rgb, shown.thermal if code is not PAIR else shown.thermal[:, :1]])
    if net.feed == "list":
        seen[1] = seen[1][:, :1]
    expected = net.network.conv(torch.cat(seen, 1))
    torch.testing.assert_close(net.eval()(rgb, thermal).logits, expected)
    assert net.record.views == (("thermal",) if net.feed == "thermal" else ("rgbt",))


def test_edge_map_is_that_of_opencv() -> None:
    """The same arithmetic with OpenCV's operators on bytes, whose sum wraps."""
    rng = np.random.default_rng(0)
    grey, thermal = rng.integers(0, 256, (2, 9, 11), dtype=np.uint8)
    halves = []
    for each in (grey, thermal):
        across, down = (
            cv2.convertScaleAbs(cv2.Sobel(each, cv2.CV_16S, *order)) for order in ((1, 0), (0, 1))
        )
        halves.append(cv2.addWeighted(across, 0.5, down, 0.5, 0))
    rgb = torch.tensor(grey / 255).expand(1, 3, 9, 11)
    found = edge_map(rgb, torch.tensor(thermal / 255)[None, None])
    np.testing.assert_array_equal(found[0], halves[0] + halves[1])
    assert (halves[0].astype(int) + halves[1] > 255).any()


def test_paths_lead_through_lists_keys_attributes_and_elements() -> None:
    output = [1, {"out": SimpleNamespace(scores=(2, 3))}, [{"a": torch.ones(2)}] * 4]
    assert picked(output, ()) is output
    assert picked(output, (1, "out", "scores", -1)) == 3
    assert picked(output, (2, "*", "a")).shape == (4, 2)
    for path in ((7,), (1, "in"), (0, 0)):
        with pytest.raises(LookupError):
            picked(output, path)


def test_scores_are_added_and_checked() -> None:
    one, two = torch.ones(2, 3, 4, 5), torch.full((2, 3, 4, 5), 2.0)
    found = scores_at((one, [two]), ((0,), (1, 0)), "model.scores", (2, 3))
    assert torch.equal(found, torch.full((2, 3, 4, 5), 3.0))


@pytest.mark.parametrize(
    ("output", "paths", "reason"),
    [
        (torch.ones(2, 3, 4, 5), ((0,),), r"at \[0\] of Tensor \(2, 3, 4, 5\) float32, got Tensor"),
        (
            (torch.ones(2, 3, 4, 5), [1, 2]),
            ((),),
            r"at \[\] of tuple \(Tensor .*, list of 2\), got tuple",
        ),
        ([torch.ones(2, 3, 4, 5)], ((3,),), r"returns list .* which has nothing at \[3\]"),
        ({"out": 1}, (("in",),), r"returns dict with out, which has nothing at \['in'\]"),
        (torch.ones(2, 5, 4, 5), ((),), r"scores of 5 classes, but model\.num_classes is 3"),
        (torch.ones(1, 3, 4, 5), ((),), r"expected class scores \(2, 3, h, w\)"),
        (torch.ones(2, 3, 4, 5, dtype=torch.int64), ((),), r"got Tensor \(2, 3, 4, 5\) int64"),
        (torch.ones(2, 3, 4, 5, dtype=torch.complex64), ((),), "got Tensor .* complex64"),
        (
            (torch.ones(2, 3, 4, 5), torch.ones(2, 3, 2, 2)),
            ((0,), (1,)),
            "cannot be added; choose paths",
        ),
    ],
)
def test_other_outputs_are_refused(output: Any, paths: Any, reason: str) -> None:
    with pytest.raises(InputError, match=f"^model.scores: .*{reason}"):
        scores_at(output, paths, "model.scores", (2, 3))


def test_structure_names_the_first_elements() -> None:
    assert structure([1, (2, 3), None, "a", 5]) == "list (int 1, tuple of 2, None, str 'a', ...)"
