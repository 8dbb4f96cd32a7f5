"""A user's own components that do not follow the interfaces are refused with one message."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from rgbt.assembly import contracts
from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.maskers.masker import check_masker
from rgbt.requirements import LossRecord, NetworkRecord, record_of
from rgbt.types import MaskPair, Output, Sample
from tests.conftest import WriteMFNet
from tests.data.layouts import refused

HW = (4, 6)
SAMPLE = Sample(np.zeros((*HW, 3), np.uint8), np.zeros(HW, np.uint8), np.zeros(HW, np.uint8), "a")
CELLS = torch.zeros(1, 4, 5).bool()
RGB = torch.zeros(2, 3, *HW)
VALUE = torch.ones((), requires_grad=True)


class Own:
    """A data set that can be made wrong in one place."""

    root, name, num_classes = "x", "mine", 2
    classes, palette = ("road", "car"), ((0, 0, 0), (1, 1, 1))
    unscored, background, splits = (), (), {"train": "x"}
    sample: Any = SAMPLE

    def has(self, split): ...
    def names(self, split):
        return ("a",)

    def read(self, name):
        return self.sample

    def label(self, name): ...
    def files(self, name): ...
    def nights(self, names): ...
    def fingerprint(self): ...
    def decoding(self): ...


def own(**changes: Any) -> Any:
    return type("Own", (Own,), changes)()


def members(**changes: Any) -> None:
    contracts.check_dataset(own(**changes))


def first(**changes: Any) -> None:
    contracts.check_dataset(own(**changes), ["train"])


def sample(**changes: Any) -> None:
    first(sample=replace(SAMPLE, **changes))


def drawn(found: Any) -> None:
    """A mask of the cells of 120 x 160 pixels, which are padded to 128 x 160."""
    halves = type("Halves", (), {"__call__": lambda self, image_hw, centre_yx, generator: found})()
    check_masker(halves, (120, 160), torch.Generator())


class Net(nn.Module):
    def __init__(self, found: Any, **record: Any) -> None:
        super().__init__()
        self.found, self.record = found, NetworkRecord(**record)
        contracts.watch_model(self, 5)

    def forward(self, rgb, thermal, masks=None, *, views=(), generator=None):
        return self.found


def passed(found: Any, **record: Any) -> None:
    Net(found, **record)(RGB, RGB[:, :1])


def compared(found: Any) -> None:
    def focal(output, batch, generator):
        return found

    contracts.CheckedLoss(focal)(None, None, None)


def mapped(found: Any) -> None:
    halves = SimpleNamespace(name="x", partition="x", regions=2, absent="released")
    halves.map = lambda image_hw: found
    contracts.check_regions(halves, HW)


REFUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: members(fingerprint=None), "dataset: Own.fingerprint(): "),
    (lambda: members(names=lambda self: ()), "dataset: Own.names(split): "),
    (lambda: members(palette=()), "num_classes=2, 2 classes and 0 colours in palette"),
    (lambda: first(sample=(1, 2)), "read('a') returned tuple; expected Sample."),
    (lambda: sample(name="b"), "read('a') returned the name 'b'; expected 'a'."),
    (lambda: sample(rgb=SAMPLE.rgb.astype("f")), "rgb ndarray (4, 6, 3) float32; expected"),
    (lambda: sample(rgb=None), "returned rgb None; expected (H, W, 3) uint8"),
    (lambda: sample(thermal=SAMPLE.rgb), "thermal ndarray (4, 6, 3) uint8; expected (4, 6) uint8"),
    (lambda: sample(label=SAMPLE.label[:3]), "label ndarray (3, 6) uint8; expected (4, 6)"),
    (lambda: sample(label=np.full(HW, 2, np.uint8)), "the label value 2 (24 pixels); expected 0"),
    (lambda: drawn(None), "Halves returned None; expected MaskPair(rgb, thermal)"),
    (lambda: drawn(MaskPair(1, 2)), "returned int 1; expected MaskPair"),
    (lambda: drawn(MaskPair(1.0 * CELLS, 1.0 * CELLS)), "returned Tensor (1, 4, 5) float32"),
    (lambda: drawn(MaskPair(*[torch.zeros(1, 15, 20).bool()] * 2)), "dividing 128 and 160"),
    (lambda: drawn(MaskPair(CELLS, CELLS.repeat(1, 2, 2))), "returned Tensor (1, 8, 10) bool"),
    (lambda: passed(RGB), "Net.forward returned Tensor (2, 3, 4, 6) float32; expected Output."),
    (lambda: passed(Output(RGB, {})), "(2, 3, 4, 6) float32; expected (2, 5, 4, 6)."),
    (lambda: passed(Output(torch.zeros(2, 5, 2, 3), {})), "logits Tensor (2, 5, 2, 3) float32"),
    (lambda: passed(Output(None, {})), "returned logits None; expected"),
    (lambda: passed(Output(RGB, {}), auxiliary=True), "aux without `aux_logits`"),
    (lambda: passed(Output(RGB, {}), features=True), "aux without `features`"),
    (lambda: contracts.watch_model(nn.Linear(1, 1), 5), "model: Linear.forward(rgb,"),
    (lambda: passed(None, outputs="masks", stacks_passes=True), "passes=, num_predictions="),
    (lambda: compared(VALUE), "loss: focal returned Tensor () float32; expected dict."),
    (lambda: compared({"a": 1.0}), "a float 1.0; expected (P)"),
    (lambda: compared({"a": VALUE}), "a Tensor () float32; expected (P)"),
    (lambda: compared({"a": torch.ones(1)}), "none of which depends on the network"),
    (lambda: contracts.CheckedLoss([]), "loss: list has no `__call__`"),
    (lambda: contracts.check_part("scheme", own()), "scheme: Own has no `phases`"),
    (lambda: mapped(np.full(HW, 2, np.uint8)), "returned 2; expected regions 0 to 1"),
    (lambda: mapped(np.zeros(HW)), "ndarray (4, 6) float64; expected (4, 6) uint8"),
    (lambda: contracts.check_part("metric", 3), "metric: int has no `name`"),
]


@pytest.mark.parametrize(("use", "word"), REFUSED, ids=[word[:50] for _, word in REFUSED])
def test_part_that_does_not_fit_is_one_sentence(use: Callable[[], Any], word: str) -> None:
    assert word in refused(use)


def test_part_that_fits_passes(write_mfnet: WriteMFNet) -> None:
    members()
    first()
    sample(label=None)
    drawn(MaskPair(CELLS, CELLS))
    assert contracts.is_own(own())
    assert not contracts.is_own(MFNet(str(write_mfnet({"train": ["00001D"]}))))


def test_network_is_examined_once_in_training_and_in_evaluation() -> None:
    net = Net(Output(None, {"masks": RGB}), outputs="masks")
    net(RGB, RGB[:, :1])
    assert "returned logits None; expected" in refused(lambda: net.eval()(RGB, RGB[:, :1]))
    net = Net(Output(torch.zeros(2, 5, *HW), {}))
    net(rgb=RGB, thermal=RGB)
    assert net._forward_hooks
    net.eval()(RGB, RGB)
    assert not net._forward_hooks
    net.found = "anything"
    assert net(RGB, RGB) == "anything"


def test_loss_passes_its_attributes_on() -> None:
    class Loss:
        record = LossRecord(weighs_confidence=True)

        def __call__(self, output, batch, generator):
            return {"a": VALUE[None]}

    loss = contracts.CheckedLoss(Loss())
    assert record_of(loss, LossRecord).weighs_confidence
    checked = contracts.CheckedLoss(lambda output, batch, generator: {})
    assert record_of(checked, LossRecord) == LossRecord()
    assert loss(None, None, None)["a"].shape == (1,)


def test_loss_between_two_frames_is_called_with_both() -> None:
    class Loss:
        record = LossRecord(frames=2)

        def __init__(self, value: torch.Tensor) -> None:
            self.value = value

        def __call__(self, first, second, warped, valid, generator):
            return {"a": self.value}

    assert contracts.CheckedLoss(Loss(VALUE))(*[None] * 5)["a"] is VALUE
    with pytest.raises(InputError, match=r"a Tensor \(1,\) float32; expected \(\)"):
        contracts.CheckedLoss(Loss(VALUE[None]))(*[None] * 5)
