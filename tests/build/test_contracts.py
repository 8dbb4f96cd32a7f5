"""Parts of one's own that do not do what they must: one sentence each."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from rgbt.build import contracts
from rgbt.checks import described
from rgbt.data.mfnet import MFNet
from rgbt.maskers.contract import check_masker
from rgbt.requirements import Record, record_of
from rgbt.types import MaskPair, Output, Phase, Sample
from tests.conftest import WriteMFNet
from tests.data.folder_files import refused

HW = (4, 6)
SAMPLE = Sample(np.zeros((*HW, 3), np.uint8), np.zeros(HW, np.uint8), np.zeros(HW, np.uint8), "a")


class Own:
    """A data set that can be made wrong in one place."""

    root, name, num_classes = "x", "mine", 2
    classes, palette = ("road", "car"), ((0, 0, 0), (1, 1, 1))
    unscored, splits = (), {"train": "x"}
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


def test_a_right_data_set_passes(write_mfnet: WriteMFNet) -> None:
    contracts.check_dataset(own())
    contracts.check_first_sample(own(), "train")
    contracts.check_first_sample(own(sample=replace(SAMPLE, label=None)), "train")
    assert contracts.is_own(own())
    assert not contracts.is_own(MFNet(str(write_mfnet({"train": ["00001D"]}))))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"fingerprint": None}, "dataset: Own has no method fingerprint(); docs/extending.md"),
        ({"names": lambda self: ()}, "dataset: Own.names is called as names(split), which it does"),
        ({"classes": "road"}, "dataset: Own.classes is str 'road'; expected a tuple."),
        ({"palette": ()}, "dataset: Own has num_classes=2, 2 classes and 0 colours in palette"),
    ],
)
def test_members_of_a_data_set(changes: dict[str, Any], sentence: str) -> None:
    assert sentence in refused(lambda: contracts.check_dataset(own(**changes)))


def test_a_data_set_without_an_attribute() -> None:
    lacking = SimpleNamespace(root="x")
    assert "dataset: SimpleNamespace has no attribute `name`" in refused(
        lambda: contracts.check_dataset(lacking)
    )


WRONG = replace(SAMPLE, label=np.full(HW, 2, np.uint8))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"names": lambda self, split: [1]}, "names('train') returned list; expected a tuple of"),
        ({"names": lambda self, split: ()}, "dataset: Own.names('train') returned no name"),
        ({"sample": (1, 2)}, "dataset: Own.read('a') returned tuple; expected rgbt.types.Sample."),
        ({"sample": replace(SAMPLE, name="b")}, "read('a') returned the name 'b'; expected 'a'."),
        (
            {"sample": replace(SAMPLE, rgb=SAMPLE.rgb.astype(np.float32))},
            "read('a') returned rgb ndarray (4, 6, 3) float32; expected ndarray (4, 6, 3) uint8.",
        ),
        (
            {"sample": replace(SAMPLE, thermal=SAMPLE.rgb)},
            "read('a') returned thermal ndarray (4, 6, 3) uint8; expected ndarray (4, 6) uint8.",
        ),
        (
            {"sample": replace(SAMPLE, label=SAMPLE.label[:3])},
            "read('a') returned label ndarray (3, 6) uint8; expected ndarray (4, 6) uint8.",
        ),
        ({"sample": replace(SAMPLE, rgb=None)}, "returned rgb None; expected ndarray (H, W, 3)"),
        ({"sample": WRONG}, "returned the label value 2 (24 pixels); expected 0 to 1, or 255"),
    ],
)
def test_samples_of_a_data_set(changes: dict[str, Any], sentence: str) -> None:
    assert sentence in refused(lambda: contracts.check_first_sample(own(**changes), "train"))


class Halves:
    found: Any = MaskPair(torch.zeros(1, 4, 5).bool(), torch.zeros(1, 4, 5).bool())

    def __call__(self, image_hw, centre_yx, generator):
        return self.found


def masker(**changes: Any) -> Any:
    return type("Halves", (Halves,), changes)()


def drawn(which: Any) -> None:
    check_masker(which, (120, 160), torch.Generator())


def test_a_crop_is_padded_before_cells_are_cut() -> None:
    drawn(masker())  # 128 x 160 pixels in 4 x 5 cells of 32


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"found": None}, "masker: Halves.__call__ returned None; expected MaskPair(rgb, thermal)"),
        ({"found": MaskPair(1, 2)}, "masker: Halves.__call__ returned MaskPair; expected MaskPair"),
        (
            {"found": MaskPair(torch.zeros(1, 4, 5), torch.zeros(1, 4, 5))},
            "rgb is Tensor (1, 4, 5) float32; expected",
        ),
        (
            {"found": MaskPair(*[torch.zeros(1, 15, 20).bool()] * 2)},
            "dividing 128 and 160: a crop of 120x160 pixels is padded to 128x160 before cells are",
        ),
        (
            {"found": MaskPair(torch.zeros(1, 4, 5).bool(), torch.zeros(1, 8, 10).bool())},
            "rgb and thermal differ in size",
        ),
        ({"__call__": lambda self, hw: None}, "is called as __call__(image_hw, centre_yx, gener"),
    ],
)
def test_masks(changes: dict[str, Any], sentence: str) -> None:
    assert sentence in refused(lambda: drawn(masker(**changes)))


class Net(nn.Module):
    def __init__(self, found: Any) -> None:
        super().__init__()
        self.found = found

    def forward(self, rgb, thermal, masks=None, *, views=(), generator=None):
        return self.found


RGB = torch.zeros(2, 3, *HW)


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (
            RGB,
            "model: Net.forward returned Tensor (2, 3, 4, 6) float32; expected Output(logits (2,",
        ),
        (Output(RGB, None), "returned aux None; expected a dictionary."),
        (Output(RGB, {}), "logits Tensor (2, 3, 4, 6) float32; expected logits (2, 5, 4, 6): one"),
        (Output(torch.zeros(2, 5, 2, 3), {}), "logits Tensor (2, 5, 2, 3) float32; expected"),
    ],
)
def test_what_a_network_returns(found: Any, sentence: str) -> None:
    net = Net(found)
    contracts.watch_model(net, 5)
    assert sentence in refused(lambda: net(RGB, RGB[:, :1]))


def test_auxiliary_in_the_record_requires_auxiliary_scores() -> None:
    net = Net(Output(torch.zeros(2, 5, *HW), {}))
    net.record = Record(auxiliary=True)
    contracts.watch_model(net, 5)
    assert "aux without `aux_logits`" in refused(lambda: net(RGB, RGB[:, :1]))


def test_a_network_is_looked_at_once_in_training_and_once_in_evaluation() -> None:
    net = Net(Output(None, {"masks": RGB}))
    contracts.watch_model(net, 5)
    assert "returned logits None; expected" in refused(lambda: net(RGB, RGB[:, :1]))
    net = Net(Output(None, {"masks": RGB}))
    net.record = Record(outputs="masks")
    contracts.watch_model(net, 5)
    net(RGB, RGB[:, :1])
    assert "returned logits None; expected" in refused(lambda: net.eval()(RGB, RGB[:, :1]))
    net = Net(Output(torch.zeros(2, 5, *HW), {}))
    contracts.watch_model(net, 5)
    net(rgb=RGB, thermal=RGB)
    assert net._forward_hooks
    net.eval()(RGB, RGB)
    assert not net._forward_hooks
    net.found = "anything"
    assert net(RGB, RGB) == "anything"


def test_a_network_that_is_called_otherwise() -> None:
    assert "model: Linear.forward is called as forward(rgb, thermal, masks, views=..., gen" in (
        refused(lambda: contracts.watch_model(nn.Linear(1, 1), 5))
    )


VALUE = torch.ones((), requires_grad=True)


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (VALUE, "Tensor () float32; expected a dictionary of named tensors, (P,), one value per"),
        ({}, "dict with nothing; expected a dictionary"),
        ({"a": 1.0}, "'a': float 1.0; expected"),
        ({"a": VALUE}, "'a': Tensor () float32; expected"),
        ({"a": torch.ones(1)}, "dict with a, of which no part depends on the network."),
    ],
)
def test_what_a_loss_returns(found: Any, sentence: str) -> None:
    def focal(output, batch, generator):
        return found

    loss = contracts.CheckedLoss(focal)
    assert f"loss: focal returned {sentence}" in refused(lambda: loss(None, None, None))


def test_a_loss_passes_its_attributes_on() -> None:
    class Loss:
        record = Record(weighs_confidence=True)

        def __call__(self, output, batch, generator):
            return {"a": VALUE[None]}

    loss = contracts.CheckedLoss(Loss())
    assert record_of(loss).weighs_confidence
    assert record_of(contracts.CheckedLoss(lambda output, batch, generator: {})) == Record()
    assert loss(None, None, None)["a"].shape == (1,)
    assert "loss: list has no method __call__(output, batch, generator)" in refused(
        lambda: contracts.CheckedLoss([])
    )


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (VALUE, "phases returned Tensor () float32; expected to yield Phase("),
        (None, "phases returned None; expected to yield Phase("),
        (Phase(("main",), {"a": VALUE}), "phases returned Phase; expected to yield Phase("),
        ([VALUE], "phases yielded Tensor () float32; expected Phase("),
        ([{"a": VALUE}], "phases yielded dict with a; expected Phase("),
        ([Phase("main", {"a": VALUE})], 'phases yielded Phase; expected Phase(("main",), parts)'),
        ([Phase(("mian",), {"a": VALUE})], "of the optimizer 'mian'; expected names out of main."),
        ([Phase(("main",), VALUE)], "yielded Tensor () float32; expected a dictionary of named"),
        ([Phase(("main",), {"a": VALUE[None]})], "'a': Tensor (1,) float32; expected a dictionary"),
    ],
)
def test_what_a_scheme_yields(found: Any, sentence: str) -> None:
    class Twice:
        def phases(self, batch, generator_of):
            return found

    scheme = contracts.CheckedScheme(Twice(), ("main",))
    said = refused(lambda: list(scheme.phases(None, None)))
    assert said.startswith("scheme: Twice.")
    assert sentence in said


def test_a_right_scheme_passes() -> None:
    phase = Phase(("main",), {"a": VALUE})
    twice = SimpleNamespace(phases=lambda batch, generator_of: iter([phase]), others={"x": 1})
    scheme = contracts.CheckedScheme(twice, ("main",))
    assert list(scheme.phases(None, None)) == [phase]
    assert scheme.others == {"x": 1}
    assert "no method phases(batch, generator_of)" in refused(
        lambda: contracts.CheckedScheme(SimpleNamespace(), ("main",))
    )


def test_transforms_partitions_and_corruptions() -> None:
    rng = np.random.default_rng(0)
    wrong = SimpleNamespace(train=lambda sample, rng: sample, test=lambda sample: sample)
    assert "transform: SimpleNamespace.train returned Sample without `centre_yx`" in refused(
        lambda: contracts.check_transform(wrong, SAMPLE, rng)
    )
    halves = SimpleNamespace(name="x", partition="x", regions=2, absent="released")
    halves.map = lambda image_hw: np.full(image_hw, 2, np.uint8)
    assert "with values up to 2; expected ndarray (4, 6) uint8 of regions 0 to 1." in refused(
        lambda: contracts.check_regions(halves, HW)
    )
    halves.map = lambda image_hw: np.zeros(image_hw)
    assert "returned ndarray (4, 6) float64; expected" in refused(
        lambda: contracts.check_regions(halves, HW)
    )
    haze = SimpleNamespace(title="haze", unit="", severities=(1.0,), check=lambda severity: None)
    assert "corruption: SimpleNamespace has no method __call__(sample, severity, rng_of)" in (
        refused(lambda: contracts.check_corruption(haze))
    )


def test_values_are_described_briefly() -> None:
    assert [described(each) for each in (None, 3, "a", [1], {"loss": 1})] == [
        *("None", "int 3", "str 'a'", "list", "dict with loss")
    ]
