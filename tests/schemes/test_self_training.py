"""Self-training: class mixing, the teacher, the loss of a step, and a resumed run."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.engine.checkpoint import State
from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.losses.distances import FeatureDistance
from rgbt.models.parts import drop_channels
from rgbt.randomness import torch_generator
from rgbt.requirements import MaskerRecord, SchemeRecord, record_of
from rgbt.schemes.self_training import (
    CONFIDENCE,
    CONFIDENT_SHARE,
    SelfTraining,
    Teacher,
    mixed,
    pasted_pixels,
    seen_as,
)
from rgbt.transforms.strong import StrongAugmentation
from rgbt.types import Batch, MaskPair, Phase, TwoDomains
from tests.losses.problems import batch_of
from tests.schemes.linear import Linear, domains, generator_of, images, network, pairs, trainer

# ---- class mixing --------------------------------------------------------------------------------


def pair_of(value: float, label: int) -> Batch:
    size = (1, 2, 3)
    rgb = torch.full((1, 3, 2, 3), value) * torch.tensor([1.0, 2.0, 3.0]).view(1, 3, 1, 1)
    thermal, weight = torch.full((1, *size), 10 * value), torch.full(size, 0.25)
    label_ = torch.full(size, label)
    return replace(batch_of(label_), rgb=rgb, thermal=thermal, confidence=weight)


@pytest.mark.parametrize(("values", "pasted"), [([0, 3, 7, 9], 2), ([0, 3, 255], 2), ([5], 1)])
def test_half_of_the_values_of_the_batch_are_pasted(values: list[int], pasted: int) -> None:
    """Rounded up, 255 among them; each image has all values here."""
    label = torch.tensor(values).expand(8, 2, -1).contiguous()
    masks = pasted_pixels(label, torch_generator(0, "class mix", 0))
    for image in masks:
        # Whole classes: both rows are the same.
        assert torch.equal(image[0], image[1])
        assert image[0].sum() == pasted
    assert len(values) == 1 or not all(torch.equal(masks[0], mask) for mask in masks)


def test_images_label_and_weight_are_pasted_with_one_mask() -> None:
    source, target = pair_of(0.01, label=3), pair_of(0.02, label=5)
    pasted = torch.tensor([[[True, False, False], [False, True, False]]])
    found = mixed(source, target, pasted)
    assert found.label.tolist() == [[[3, 5, 5], [5, 3, 5]]]
    assert found.confidence.tolist() == [[[1.0, 0.25, 0.25], [0.25, 1.0, 0.25]]]
    for name in ("rgb", "thermal"):
        one, two, mix = (getattr(batch, name) for batch in (source, target, found))
        assert torch.equal(mix[0, :, pasted[0]], one[0, :, pasted[0]])
        assert torch.equal(mix[0, :, ~pasted[0]], two[0, :, ~pasted[0]])
        assert not torch.equal(one, two)


def test_views_that_differ_paste_what_the_source_sees() -> None:
    batch = pair_of(0.1, label=3)
    # (0.1, 0.2, 0.3): 0.0299 + 0.1174 + 0.0342.
    thermal = seen_as(batch, "rgb", "thermal").thermal
    torch.testing.assert_close(thermal, torch.full_like(thermal, 0.1815))
    rgb = seen_as(batch, "thermal", "rgb").rgb
    assert torch.equal(rgb, torch.ones_like(rgb))
    for views in (("rgb", "rgb"), ("thermal", "thermal"), (None, None), ("rgbt", "rgb")):
        assert seen_as(batch, *views) is batch


# ---- the teacher ---------------------------------------------------------------------------------


class Net(nn.Module):
    """A normalisation, a weight, and dropout in training."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(1)
        self.weight = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
        self.double()

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.weight * drop_channels(self.norm(x), 0.9 if self.training else 0.0, generator)


PIXELS = torch.tensor([1.0, 3.0, 5.0, 7.0], dtype=torch.float64).view(1, 1, 2, 2)


def teacher_of(network: nn.Module, decay: float = 0.999, norm: Any = "batch") -> Teacher:
    return Teacher(network, decay=decay, normalisation=norm)


def test_average_follows_its_recursion_once_a_step() -> None:
    network = Net()
    teacher = teacher_of(network, decay=0.6)
    values, expected = [5.0, 1.0, 4.0, 2.0, 8.0], 0.0
    for step, value in enumerate(values):
        network.weight.data.fill_(value)
        teacher.update(step)
        share = min(1 - 1 / (step + 1), 0.6)
        expected = share * expected + (1 - share) * value
        network.weight.data.fill_(-100.0)
        teacher.update(step)
        assert teacher.network().weight.item() == pytest.approx(expected, abs=1e-12)
    # After steps 0 and 1 it is their mean, 3; then 0.6 and 0.4.
    by_hand = 0.6 * (0.6 * (0.6 * 3 + 0.4 * 4) + 0.4 * 2) + 0.4 * 8
    assert expected == pytest.approx(by_hand)


@pytest.mark.parametrize("norm", ["batch", "running"])
def test_teacher_predicts_without_dropout_and_changes_no_statistics(norm: str) -> None:
    network = Net()
    with torch.no_grad():
        network.norm.running_mean.fill_(3.0)
        network.norm.running_var.fill_(4.0)
    teacher = teacher_of(network, norm=norm)
    network.weight.data.fill_(4.0)
    before = {name: each.clone() for name, each in teacher.average.state_dict().items()}
    for _ in range(2):
        found = teacher.network()(PIXELS)  # without a generator, so that dropout would raise
        # Mean 4 and variance 5 of the batch, or mean 3 and variance 4 of the network; weight 2.
        mean, variance = (4.0, 5.0) if norm == "batch" else (3.0, 4.0)
        expected = 2 * (PIXELS - mean) / (variance + network.norm.eps) ** 0.5
        torch.testing.assert_close(found, expected)
    assert not found.requires_grad
    after = teacher.average.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert network.norm.training
    assert network.norm.track_running_stats
    network.norm.running_mean.fill_(5.0)
    teacher.update(7)  # statistics are those of the student
    assert teacher.network().norm.running_mean.item() == 5.0


# ---- a step --------------------------------------------------------------------------------------

THRESHOLD = 0.44
"""Some pixels of the linear network are above it, and some below."""


class Halves:
    """Hides the left half of RGB, and the right half of thermal."""

    record = MaskerRecord(hides_cells=True)

    def __call__(
        self, image_hw: tuple[int, int], centre_yx: Tensor, generator: torch.Generator
    ) -> MaskPair:
        del image_hw, generator
        left = torch.tensor([[True, False]] * 2).expand(len(centre_yx), 2, 2)
        return MaskPair(left, ~left)


def scheme_of(model: Linear, *, jitter: float = 0.0, **changes: Any) -> Any:
    settings: dict[str, Any] = {
        "decay": 0.999,
        "teacher_norm": "batch",
        "threshold": THRESHOLD,
        "weighted_by": "batch",
        "ignored_top": 0.0,
        "ignored_bottom": 0.0,
        "mixing": "classes",
        "masked_weight": 0.5,
        "masked_images": "target",
        "domains": domains(False, labels="none", view="rgb"),
        "masker": Halves(),
        "loss": CrossEntropy(class_weights=None),
        **changes,
    }
    strong = StrongAugmentation(
        jitter_probability=jitter,
        jitter_strength=0.2,
        blur_probability=jitter,
        blur_sigma=(0.15, 1.15),
    )
    return SelfTraining(model=model, augmentation=strong, **settings)


DISTANCE: dict[str, Any] = {
    "feature_distance": FeatureDistance(weight=0.005, things=("b", "c"), min_share=0.75),
    "dataset": SimpleNamespace(classes=("a", "b", "c")),
}


def batches(step: int = 0) -> TwoDomains:
    target = images("target", 0).to("cpu")
    unlabelled = replace(target, label=torch.full_like(target.label, 255))
    return TwoDomains(images("source", 0).to("cpu"), unlabelled, step)


def phase_of(scheme: Any, data: TwoDomains) -> Phase:
    (phase,) = scheme.phases(data, generator_of)
    return phase


def logits(model: Linear, image: Tensor, head: Any = None) -> Tensor:
    """(2, K, 4, 4) of three channels, by the definition of the network."""
    last = model.only if head is None else model.heads[head]
    assert last is not None
    weight = last.weight.flatten(1) @ model.backbone.weight.flatten(1)
    return torch.einsum("kc,bchw->bkhw", weight, image)


def cost(scores: Tensor, label: Tensor, weight: Tensor) -> Tensor:
    """Weighted nats over all pixels, divided by their number."""
    nats = scores.logsumexp(1) - scores.gather(1, label[:, None])[:, 0]
    return (weight * nats).sum() / label.numel()


def teacher_labels(model: Linear, target: Batch) -> tuple[Tensor, Tensor]:
    probability, label = logits(model, target.rgb).softmax(1).max(1)
    return label, (probability >= THRESHOLD).double().mean()


def masked(image: Tensor) -> Tensor:
    """RGB without its left half."""
    return torch.cat([torch.zeros_like(image[..., :2]), image[..., 2:]], -1)


@pytest.mark.parametrize("mixing", ["classes", "none"])
def test_parts_of_a_step_by_their_definition(mixing: str) -> None:
    model, data = network(False), batches()
    phase = phase_of(scheme_of(model, mixing=mixing), data)
    label, share = teacher_labels(model, data.target)
    assert 0 < share < 1
    pasted = pasted_pixels(data.source.label, generator_of("class mix"))
    assert pasted.any()
    assert not pasted.all()
    pasted &= mixing == "classes"
    image = torch.where(pasted[:, None], data.source.rgb, data.target.rgb)
    weight = torch.where(pasted, 1.0, share.float())
    ones = torch.ones(2, 4, 4)
    expected = {
        "source/cross_entropy": cost(logits(model, data.source.rgb), data.source.label, ones),
        "target/cross_entropy": cost(
            logits(model, image), torch.where(pasted, data.source.label, label), weight
        ),
        "target/masked_cross_entropy": 0.5
        * cost(logits(model, masked(data.target.rgb)), label, share.float() * ones),
    }
    assert list(phase.parts) == list(expected)
    for name, value in expected.items():
        torch.testing.assert_close(phase.parts[name], value)
    assert phase.logged[CONFIDENT_SHARE].item() == pytest.approx(share.item())
    confidence = logits(model, data.target.rgb).softmax(1).amax(1).mean()
    torch.testing.assert_close(phase.logged[CONFIDENCE], confidence)


def test_masked_images_of_each_domain_have_half_the_weight() -> None:
    model, data = network(False), batches()
    phase = phase_of(scheme_of(model, masked_images="both", jitter=1.0), data)
    label, share = teacher_labels(model, data.target)
    ones = torch.ones(2, 4, 4)
    source = cost(logits(model, masked(data.source.rgb)), data.source.label, ones)
    target = cost(logits(model, masked(data.target.rgb)), label, share.float() * ones)
    # Not augmented, although the mix is.
    torch.testing.assert_close(phase.parts["source/masked_cross_entropy"], 0.25 * source)
    torch.testing.assert_close(phase.parts["target/masked_cross_entropy"], 0.25 * target)


def test_masks_of_source_and_target_are_drawn_apart() -> None:
    seen: list[Tensor] = []

    class Drawn(Halves):
        def __call__(self, image_hw: Any, centre_yx: Tensor, generator: Any) -> MaskPair:
            hidden = torch.rand(len(centre_yx), 2, 2, generator=generator) < 0.5
            seen.append(hidden)
            return MaskPair(hidden, ~hidden)

    phase_of(scheme_of(network(False), masker=Drawn(), masked_images="both"), batches())
    source, target = seen
    assert not torch.equal(source, target)


def test_only_mix_and_masked_target_are_augmented() -> None:
    model, data = network(False), batches()
    plain = phase_of(scheme_of(model), data)
    strong = phase_of(scheme_of(model, jitter=1.0), data)
    assert torch.equal(plain.parts["source/cross_entropy"], strong.parts["source/cross_entropy"])
    for name in ("target/cross_entropy", "target/masked_cross_entropy"):
        assert not torch.isclose(plain.parts[name], strong.parts[name])
    assert plain.logged[CONFIDENCE] == strong.logged[CONFIDENCE]


def test_feature_distance_is_measured_on_things_of_the_source() -> None:
    model, data = network(False), batches()
    scheme = scheme_of(model, **DISTANCE)
    start = model.backbone.weight.detach().clone()
    with torch.no_grad():
        model.backbone.weight.add_(torch.randn(start.shape, generator=generator_of("other")))
    phase = phase_of(scheme, data)
    weight = (model.backbone.weight - start).flatten(1)
    apart = torch.einsum("kc,bchw->bkhw", weight, data.source.rgb).norm(dim=1)
    expected = 0.005 * apart[data.source.label > 0].mean()
    torch.testing.assert_close(phase.parts["source/feature_distance"], expected)
    parts = phase_of(scheme_of(model), data).parts
    assert set(phase.parts) - set(parts) == {"source/feature_distance"}
    assert all(torch.equal(phase.parts[name], parts[name]) for name in parts)
    assert set(record_of(scheme, SchemeRecord).networks) == {"teacher"}


def test_initial_network_sees_the_source_with_its_own_statistics() -> None:
    model = network(False)
    model.norm = torch.nn.BatchNorm2d(1)
    scheme = scheme_of(model, domains=domains(False, labels="none"), **DISTANCE)
    model.norm.running_mean.fill_(3.0)
    phase_of(scheme, batches())
    seen = [
        (net.calls, net.norm.training, net.norm.running_mean.item())
        for net in (scheme.teacher.network(), scheme.initial)
    ]
    # The teacher has the statistics of its batch, the initial network those of the start.
    assert seen[0] == ([(("thermal",), None, False)], True, 3.0)
    assert seen[1] == ([(("rgb",), None, False)], False, 0.0)


def test_ignored_rows_leave_rows_for_pseudo_labels() -> None:
    model, data = network(False), batches()
    scheme = scheme_of(model, ignored_top=0.5, ignored_bottom=0.25, mixing="none")
    label, share = teacher_labels(model, data.target)
    third_row = torch.tensor([0.0, 0.0, 1.0, 0.0])[:, None].expand(2, 4, 4)
    expected = cost(logits(model, data.target.rgb), label, share.float() * third_row)
    torch.testing.assert_close(phase_of(scheme, data).parts["target/cross_entropy"], expected)
    for top, bottom in ((0.5, 0.5), (0.25, 0.75), (0.75, 0.25)):
        with pytest.raises(InputError, match="must be below 1"):
            scheme_of(network(False), ignored_top=top, ignored_bottom=bottom)
    scheme_of(network(False), ignored_top=0.5, ignored_bottom=0.25)
    scheme_of(network(False), ignored_top=0.25, ignored_bottom=0.5)


def test_labels_come_from_the_average_of_earlier_steps() -> None:
    """In step 1 the teacher is the mean of two networks, and the student another one."""
    model = network(False)
    scheme = scheme_of(model, masked_weight=0.0)
    first = [parameter.detach().clone() for parameter in model.parameters()]
    phase_of(scheme, batches(0))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.5 * torch.randn(parameter.shape, generator=generator_of("other")))
    found = phase_of(scheme, batches(1)).logged[CONFIDENCE]
    average = network(False)
    for mean, one, two in zip(average.parameters(), first, model.parameters(), strict=True):
        mean.data = (one + two.detach()) / 2
    image = batches().target.rgb
    torch.testing.assert_close(found, logits(average, image).softmax(1).amax(1).mean())
    apart = logits(model, image).softmax(1).amax(1).mean() - found
    assert abs(apart.item()) > 1e-3


def test_two_heads_train_each_domain_with_its_own() -> None:
    model, data = network(True), batches()
    scheme = scheme_of(model, domains=domains(True, labels="none"))
    source, target = scheme.phases(data, generator_of)
    assert (source.optimizers, target.optimizers) == (("source",), ("target",))
    assert set(source.parts) == {"source/cross_entropy"}
    assert set(target.parts) == {"target/cross_entropy", "target/masked_cross_entropy"}
    assert (set(source.logged), set(target.logged)) == ({CONFIDENT_SHARE, CONFIDENCE}, set())
    assert [head for _, head, _ in model.calls] == ["day", "dark", "dark"]
    teacher = scheme.teacher.network()
    assert [head for _, head, _ in teacher.calls] == ["dark"]
    assert record_of(scheme, SchemeRecord).networks == {"teacher": scheme.teacher.average}


@pytest.mark.parametrize("changes", [{}, DISTANCE])
def test_resumed_run_ends_with_the_same_bits(tmp_path: Path, changes: dict[str, Any]) -> None:
    """Network, teacher, optimizer and every logged value."""

    def fit(folder: Path, steps: int, state: State) -> Any:
        model = network(False)
        scheme = scheme_of(model, jitter=0.5, masked_images="both", **changes)
        made = trainer(scheme, model, folder, 6, checkpoint_minutes=0, max_steps=6)
        assert made.resume(state) == (state.step > 0 or (folder / "last.pt").exists())
        made.settings = replace(made.settings, max_steps=steps)
        made.fit(pairs(first=state.step), state)
        return made

    straight = fit(tmp_path / "straight", 6, State(seed=0))
    stopped = fit(tmp_path / "stopped", 3, State(seed=0))
    shutil.copytree(tmp_path / "stopped", tmp_path / "resumed")
    resumed = fit(tmp_path / "resumed", 6, State(seed=0))
    for one, other in ((straight.model, resumed.model), (straight.others, resumed.others)):
        states = [nets["teacher"] if isinstance(nets, dict) else nets for nets in (one, other)]
        values = [net.state_dict() for net in states]
        assert values[0].keys() == values[1].keys()
        assert all(torch.equal(values[0][name], values[1][name]) for name in values[0])
    before, after = (made.others["teacher"].state_dict() for made in (stopped, straight))
    assert not all(torch.equal(before[name], after[name]) for name in before)
    logged = [
        [
            {name: line[name] for name in line if name.startswith(("loss", "teacher"))}
            for line in log
        ]
        for log in (straight.log, stopped.log + resumed.log)
    ]
    assert logged[0] == logged[1]
    assert len({line[CONFIDENCE] for line in logged[0]}) == 6
