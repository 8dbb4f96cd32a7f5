"""The set criterion: points, matching, spatial weights, the loop it equals, and the release."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.losses import set_criterion
from rgbt.losses.points import Points, class_shares, most_uncertain, sample
from rgbt.losses.set_criterion import (
    SetCriterion,
    assign,
    mask_and_dice,
    pairwise_costs,
    targets_of,
)
from rgbt.losses.spatial import (
    PLAIN,
    PointWeights,
    SpatialMap,
    SpatialWeight,
    boundaries,
    weight_map,
)
from rgbt.types import Output
from tests.benchmarks.reference_criterion import Replayed, reference_criterion
from tests.losses.problems import (
    batch_of,
    criterion_of,
    problem_of,
    recorded_losses,
    seeded,
    whole_image,
)
from tests.models.golden import requires_golden

# ---- points and matching ----


@pytest.mark.parametrize("value", [3, 254, 256, -7])
def test_unknown_labels_are_refused(value: int) -> None:
    targets = targets_of(torch.tensor([[[0, value]]]), (1, 2), 3, None)
    with pytest.raises(ValueError, match="expected 0 to 2 or 255"):
        assign(torch.zeros(1, 1, 4, 3), targets)


def test_pairwise_costs_against_the_printed_formula() -> None:
    generator = seeded(0)
    x = 4 * torch.randn(2, 3, 50, generator=generator)
    t = torch.rand(2, 4, 50, generator=generator)
    w = PointWeights(
        1 + torch.rand(2, 50, generator=generator), torch.full((2,), 50.0), torch.tensor([1.0, 0.0])
    )
    expected = torch.zeros(2, 3, 4)
    for r, q, k in itertools.product(range(2), range(3), range(4)):
        weight, s = w.values[r], x[r, q].sigmoid()
        bce = F.binary_cross_entropy_with_logits(x[r, q], t[r, k], weight, reduction="sum") / 50
        numerator = 2 * (weight * s * t[r, k]).sum() + w.smoothing[r]
        dice = 1 - numerator / ((weight * (s + t[r, k])).sum() + w.smoothing[r])
        expected[r, q, k] = 2 * bce + 3 * dice
    assert torch.allclose(
        pairwise_costs(x, t * w.values[:, None], w, 2.0, 3.0), expected, atol=1e-5
    )


def test_assignment_is_the_cheapest_of_all() -> None:
    cost = torch.randn(6, 2, 4, 3, generator=seeded(3))
    targets = targets_of(torch.tensor([[[0, 2]], [[1, 255]]]), (1, 2), 3, None)
    matches = assign(cost, targets)
    assert matches.image.tolist() == [0, 0, 1]
    assert matches.label.tolist() == [0, 2, 1]
    for one_set in range(6):
        first = min(
            itertools.permutations(range(4), 2),
            key=lambda pair, c=cost[one_set, 0]: float(c[pair[0], 0] + c[pair[1], 2]),
        )
        assert tuple(matches.query[one_set, :2]) == first
        assert matches.query[one_set, 2] == cost[one_set, 1, :, 1].argmin()


def source(seed: int = 0) -> Points:
    return Points(seeded(seed), device=torch.device("cpu"))


def test_points_are_uniform_and_independent() -> None:
    points = source().matcher(2, 4, 50_000).reshape(-1, 2)
    assert points.abs().max() < 1
    # Uniform on [-1, 1]: mean 0, variance 1/3. 400,000 draws: five standard errors are below 0.005.
    assert torch.allclose(points.mean(0), torch.zeros(2), atol=5e-3)
    assert torch.allclose(points.var(0), torch.full((2,), 1 / 3), atol=5e-3)
    neighbours = torch.cat([points[:-1], points[1:]], dim=1)
    assert torch.corrcoef(neighbours.T).fill_diagonal_(0)[:2].abs().triu(1).max() < 0.01
    share, _ = torch.histogram(points[:, 0], bins=16, range=(-1.0, 1.0))
    assert torch.allclose(share / len(points), torch.full((16,), 1 / 16), atol=3e-3)


def test_class_shares_equal_the_sampled_one_hot_label() -> None:
    generator = seeded(0)
    label = torch.randint(0, 5, (3, 10, 14), generator=generator)
    label[label == 4] = 255
    points = 2 * torch.rand(2, 3, 500, 2, generator=generator) - 1
    points[0, 0, 0] = torch.tensor([1.0, 1.0])
    points[0, 0, 1] = torch.tensor([-1.0, -1.0])
    one_hot = torch.stack([label == k for k in range(4)], 1).float()
    expected = sample(one_hot, points.transpose(0, 1)).permute(2, 0, 1, 3)
    assert torch.allclose(class_shares(label, points, 4), expected, atol=1e-5)


def test_most_uncertain_keeps_the_smallest_magnitudes() -> None:
    logits = torch.tensor([[3.0, -1.0, 0.5, -0.0], [-9.0, 8.0, -7.0, 6.0]])
    points = torch.arange(16.0).reshape(2, 4, 2)
    kept = most_uncertain(logits.clone(), points, 2)
    assert sorted(kept[0, :, 0].tolist()) == [4.0, 6.0]
    assert sorted(kept[1, :, 0].tolist()) == [12.0, 14.0]
    assert most_uncertain(logits.clone(), points, 0).shape == (2, 0, 2)


# ---- spatial weights ----
EDGE = replace(PLAIN, alpha=2.0, focus="edge")


@pytest.mark.parametrize(
    ("focus", "middle", "side", "corner"),
    # Centre (1, 1), d_max = sqrt 2: corners 1 + 2, sides 1 + 2 / sqrt 2; reversed, 3 - that.
    [("edge", 1, 1 + 2 / sqrt(2), 3), ("center", 3, 3 - 2 / sqrt(2), 1)],
)
def test_weights_of_a_3x3_image(focus: Any, middle: float, side: float, corner: float) -> None:
    batch = batch_of(torch.zeros(1, 3, 3, dtype=torch.long), whole_image(1, 3, 3))
    row = [corner, side, corner]
    expected = torch.tensor([[row, [side, middle, side], row]])
    assert torch.allclose(weight_map(batch, (3, 3), replace(EDGE, focus=focus))[0], expected)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        # A crop of rows 0-1, columns 3-4 of a 5 x 5 image, centre (2, 2), d_max sqrt 8.
        ({}, [[sqrt(5 / 8), 1.0], [sqrt(2 / 8), sqrt(5 / 8)]]),
        ({"d_max": "crop"}, [[sqrt(5 / 8), 1.0], [sqrt(2 / 8), sqrt(5 / 8)]]),
        # Pixel (1, 1) of the crop lies at (1, 4); the farthest original pixel, (4, 0), at 5.
        ({"centre": "crop"}, [[sqrt(2) / 5, 1 / 5], [1 / 5, 0.0]]),
        ({"centre": "crop", "d_max": "crop"}, [[1.0, sqrt(0.5)], [sqrt(0.5), 0.0]]),
    ],
)
def test_centre_and_largest_distance(changes: dict[str, str], expected: list[list[float]]) -> None:
    position = whole_image(1, 5, 5)[:, :, :2, 3:]
    batch = batch_of(torch.zeros(1, 2, 2, dtype=torch.long), position, (5, 5))
    weights = weight_map(batch, (2, 2), replace(EDGE, alpha=1.0, **changes))
    assert torch.allclose(weights[0, 0], 1 + torch.tensor(expected))


def test_centre_of_an_odd_crop_is_its_middle_pixel() -> None:
    """Of 3 x 5 pixels (1, 2), at a distance of sqrt 5 from the corners."""
    batch = batch_of(torch.zeros(1, 3, 5, dtype=torch.long), whole_image(1, 5, 7)[:, :, 1:4, :5])
    weights = weight_map(batch, (3, 5), replace(EDGE, alpha=1.0, centre="crop", d_max="crop"))
    outer, middle = [1, sqrt(2 / 5), sqrt(1 / 5)], [sqrt(4 / 5), sqrt(1 / 5), 0]
    rows = [[*row, *row[1::-1]] for row in (outer, middle, outer)]
    assert torch.allclose(weights[0, 0], 1 + torch.tensor(rows))


@pytest.mark.parametrize(
    ("focus", "padding", "expected"),
    [("edge", "map", 3.0), ("center", "map", 1.0), ("edge", "one", 1.0), ("edge", "zero", 0.0)],
)
def test_padding(focus: Any, padding: Any, expected: float) -> None:
    batch = batch_of(torch.zeros(1, 3, 3, dtype=torch.long), whole_image(1, 3, 3))
    weights = weight_map(batch, (4, 5), replace(EDGE, focus=focus, padding=padding))[0, 0]
    assert (weights[3] == expected).all()
    assert (weights[:, 3:] == expected).all()


@pytest.mark.parametrize(
    ("passes", "weighted"),
    [(1, [0]), (2, [0, 1]), (3, [0]), (4, [0, 3])],  # F | F F' | F R T | F R T F'
)
def test_fused_passes(passes: int, weighted: list[int]) -> None:
    batch = batch_of(torch.zeros(2, 3, 3, dtype=torch.long), whole_image(2, 3, 3))
    settings = replace(EDGE, passes="fused", dice_smoothing="none", normaliser="weights")
    spatial = SpatialMap(batch, (3, 3), settings=settings, num_passes=passes)
    corner = torch.tensor([-2 / 3, -2 / 3]).expand(2 * passes, 2, 1, 2)
    weights = spatial.at(corner, torch.tensor([0, 1]), first_set=0)
    expected = [3.0 if s % passes in weighted else 1.0 for s in range(2 * passes)]
    assert torch.allclose(weights.values[:, 1, 0], torch.tensor(expected))
    assert torch.allclose(weights.total[:, 0], torch.tensor(expected))
    assert weights.smoothing[:, 0].tolist() == [0.0 if e == 3 else 1.0 for e in expected]


def test_boundaries_are_labelled_pixels_beside_another_class() -> None:
    # One pixel of class 1 at (1, 1), class 2 in the last column, no label at (3, 0) and (4, 1).
    label = torch.tensor(
        [
            [0, 0, 0, 0, 0, 2],
            [0, 1, 0, 0, 0, 2],
            [0, 0, 0, 0, 0, 2],
            [255, 0, 0, 0, 0, 2],
            [0, 255, 0, 0, 255, 2],
        ]
    )
    # By hand: the eight neighbours of (1, 1) and itself, the last column where a labelled 0 is
    # beside or diagonal, and column 4 where it is labelled.
    expected = torch.tensor(
        [
            [1, 1, 1, 0, 1, 1],
            [1, 1, 1, 0, 1, 1],
            [1, 1, 1, 0, 1, 1],
            [0, 0, 0, 0, 1, 1],
            [0, 0, 0, 0, 0, 1],
        ]
    ).bool()
    assert torch.equal(boundaries(label[None])[0], expected)


def test_edge_weighted_loss_weights_boundaries_without_a_position() -> None:
    label = torch.tensor([[[0, 0, 1, 1]]])
    batch = replace(batch_of(label, whole_image(1, 1, 4)), position=None)
    settings = replace(EDGE, focus="boundary")
    # Padding "map" is a pixel without a boundary.
    expected = torch.tensor([[1.0, 3, 3, 1, 1], [1, 1, 1, 1, 1]])
    assert torch.equal(weight_map(batch, (2, 5), settings)[0, 0], expected)
    with pytest.raises(InputError, match="does not track"):
        weight_map(batch, (2, 5), EDGE)


# ---- all layers and passes at once ----


def gradients(parts: dict[str, Tensor], output: Output) -> list[Tensor]:
    total = torch.stack(list(parts.values())).sum()
    return list(torch.autograd.grad(total, list(output.aux.values()), retain_graph=True))


def replayed(criterion: SetCriterion, sets: tuple[int, int], batch: Any) -> Any:
    """The same draws for the batched criterion and for the reference, 64 matcher points."""
    layers, passes = sets
    targets = sum(len(set(label.unique().tolist()) - {255}) for label in batch.label)
    points = source(5)
    matcher = points.matcher(layers * passes, len(batch.label), 64)
    return Replayed(matcher, points.loss(layers * passes, targets, criterion.num_drawn), passes)


SPATIAL = [
    PLAIN,
    EDGE,
    replace(EDGE, focus="center", normaliser="weights", dice_smoothing="none"),
    replace(EDGE, match="weighted", padding="zero", passes="fused", dice_smoothing="none"),
    replace(EDGE, match="weighted", normaliser="weights", centre="crop", d_max="crop"),
]


@pytest.mark.parametrize("spatial", SPATIAL)
@pytest.mark.parametrize("sizes", [(3, 4, 2), (1, 1, 3)])
def test_equals_the_loop_over_passes_layers_and_images(
    spatial: SpatialWeight, sizes: tuple[int, int, int]
) -> None:
    output, batch = problem_of(*sizes)
    weights = {"class_weight": 1.5, "mask_weight": 4.0, "dice_weight": 7.0}  # no two are equal
    criterion = criterion_of(spatial=spatial, **weights, no_object_weight=0.2)
    assert criterion.part_weights == {"class": 1.5, "mask": 4.0, "dice": 7.0}
    draws = replayed(criterion, sizes[:2], batch)
    batched = criterion.compare(output, batch, draws)
    expected = reference_criterion(criterion, output, batch, draws)
    for name, part in batched.items():
        assert part.shape == (sizes[1],)
        assert torch.allclose(part, expected[name], rtol=1e-5, atol=1e-6), name
    for ours, theirs in zip(gradients(batched, output), gradients(expected, output), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("queries", [2, 4])
def test_more_targets_than_queries(queries: int) -> None:
    output, batch = problem_of(2, 2, 2, queries=queries)
    criterion = criterion_of()
    draws = replayed(criterion, (2, 2), batch)
    batched = criterion.compare(output, batch, draws)
    expected = reference_criterion(criterion, output, batch, draws)
    for name, part in batched.items():
        assert torch.allclose(part, expected[name], rtol=1e-5), name


def test_only_the_last_layer_without_deep_supervision() -> None:
    output, batch = problem_of(3, 2, 2)
    last = Output(None, {name: tensor[-1:] for name, tensor in output.aux.items()})
    shallow = criterion_of(deep_supervision=False)(output, batch, seeded())
    expected = criterion_of()(last, batch, seeded())
    for name, part in shallow.items():
        assert torch.equal(part, expected[name])


@pytest.mark.parametrize(
    "spatial",
    [
        replace(EDGE, alpha=0.0, dice_smoothing="none", normaliser="weights", match="weighted"),
        replace(EDGE, focus="none"),
    ],
)
def test_alpha_0_and_no_focus_equal_the_plain_loss(spatial: SpatialWeight) -> None:
    output, batch = problem_of(2, 4, 2)
    plain = criterion_of()(output, batch, seeded())
    off = criterion_of(spatial=spatial)(output, replace(batch, position=None), seeded())
    for name, part in plain.items():
        assert torch.equal(part, off[name])
    for ours, theirs in zip(gradients(plain, output), gradients(off, output), strict=True):
        assert torch.equal(ours, theirs)


def test_a_batch_without_targets() -> None:
    output, batch = problem_of(2, 2, 2)
    empty = replace(batch, label=torch.full_like(batch.label, 255))
    parts = criterion_of(spatial=EDGE)(output, empty, seeded())
    assert parts["mask"].tolist() == [0.0, 0.0]
    assert parts["dice"].tolist() == [0.0, 0.0]
    # All queries are "no object": the mean of their cross-entropies, over both layers.
    no_object = -output.aux["class_logits"].log_softmax(-1)[..., -1].mean((2, 3)).sum(0)
    assert torch.allclose(parts["class"], 2.0 * no_object)
    classes, masks = gradients(parts, output)  # masks stay part of the graph
    assert classes.any()
    assert not masks.any()


def test_plain_losses_by_hand() -> None:
    # s = 1/2 and 3/4 against t = 1 and 0: BCE = (log 2 + log 4) / 2,
    # dice = 1 - (2 * 1/2 + 1) / (5/4 + 1 + 1) = 1 - 8/13.
    x, t = torch.tensor([[0.0, math.log(3)]]), torch.tensor([[1.0, 0.0]])
    bce, dice = mask_and_dice(x, t, None)
    assert torch.allclose(bce, torch.tensor([1.5 * math.log(2)]))
    assert torch.allclose(dice, torch.tensor([5 / 13]))


def test_weighted_losses_by_hand() -> None:
    # The same with weights 1 and 3, divided by two points: BCE = (log 2 + 3 log 4) / 2;
    # dice without smoothing = 1 - (2 * 1/2) / (1/2 + 9/4 + 1) = 1 - 4/15.
    x, t = torch.tensor([[0.0, math.log(3)]]), torch.tensor([[1.0, 0.0]])
    w = PointWeights(torch.tensor([[1.0, 3.0]]), torch.tensor([2.0]), torch.tensor([0.0]))
    bce, dice = mask_and_dice(x, t, w)
    assert torch.allclose(bce, torch.tensor([3.5 * math.log(2)]))
    assert torch.allclose(dice, torch.tensor([11 / 15]))


@pytest.mark.parametrize("size", [1, 5_000, 2**40])
def test_losses_do_not_depend_on_the_chunks(size: int, monkeypatch: Any) -> None:
    output, batch = problem_of(3, 4, 2)  # one pass, several passes, or all layers at once
    criterion = criterion_of()

    def losses() -> torch.Tensor:
        points = Points(seeded(0), device=torch.device("cpu"))
        return torch.stack(list(criterion.compare(output, batch, points).values()))

    whole = losses()
    monkeypatch.setattr(set_criterion, "CHUNK_BYTES", size)
    assert torch.allclose(whole, losses(), rtol=1e-6)


# ---- the release ----


class Golden:
    """One case: inputs by recipe, draws in the order of our criterion, stored results.

    The release counts layers from the last to the auxiliary ones, we from the first to the last;
    it numbers a mask's draws by image and query, we by image and class.
    """

    def __init__(self, name: str) -> None:
        self.fill, recipes, _, self.stored = recorded_losses("criterion")
        self.name, self.recipe = name, recipes[name]
        self.order = [1, 2, 0]  # auxiliary 0, auxiliary 1, last

    def output(self) -> Output:
        r, fill = self.recipe, self.fill
        queries, (h, w) = r["queries"], r["mask_size"]
        classes, masks = [], []
        for i in self.order:
            shape = (2, queries, r["classes"] + 1)
            classes.append(2 * fill.normal(r["logits_seeds"][i], shape))
            coarse = fill.normal(r["coarse_mask_seeds"][i], (2, queries, h // 4, w // 4))
            fine = fill.normal(r["fine_mask_seeds"][i], (2, queries, h, w))
            blocks = np.kron(coarse, np.ones((1, 1, 4, 4), np.float32))
            masks.append(np.float32(3) * blocks + fine)
        aux = {
            "class_logits": torch.from_numpy(np.stack(classes))[:, None].requires_grad_(),
            "mask_logits": torch.from_numpy(np.stack(masks))[:, None].requires_grad_(),
        }
        return Output(None, aux)

    def label(self) -> Tensor:
        height, width = self.recipe["image_size"]
        both = zip(self.recipe["label_seeds"], self.recipe["class_values"], strict=True)
        labels = [self.fill.labels(seed, height, width, values) for seed, values in both]
        return torch.from_numpy(np.stack(labels))

    def matches(self, layer: int) -> np.ndarray:
        """(G,) query of every target."""
        key = ["last", "aux0", "aux1"][layer]
        columns = []
        for image in (0, 1):
            query, target = self.stored[f"criterion.{self.name}.match.{key}.image{image}"]
            columns.append(query[np.argsort(target)])
        return np.concatenate(columns)

    def draws(self) -> Any:
        matcher, loss = [], []
        for layer in self.order:
            drawn = self.recipe["draws"][4 * layer : 4 * layer + 4]
            first, second, candidates, fresh = (
                torch.from_numpy(self.fill.uniform(d["key"], d["shape"])) for d in drawn
            )
            matcher.append(torch.cat([first, second]))
            # Row of the release's draws for every target: the rank of its query within its image.
            counts = [len(c) for c in self.recipe["target_classes"]]
            parts = np.split(self.matches(layer), [counts[0]])
            ranks = [part.argsort().argsort() for part in parts]
            rows = np.concatenate([ranks[0], ranks[1] + counts[0]])
            loss.append(torch.cat([candidates, fresh], 1)[rows])
        return Replayed(2 * torch.stack(matcher) - 1, 2 * torch.stack(loss) - 1, 1)


@requires_golden
@pytest.mark.parametrize("name", ["two_images", "one_empty_image"])
def test_released_values(name: str) -> None:
    case = Golden(name)
    output, batch = case.output(), batch_of(case.label())
    criterion = criterion_of(num_classes=9, num_points=256)
    parts = criterion.layers(output, batch, case.draws())
    for row, suffix in enumerate(["_0", "_1", ""]):
        for part, released in [("class", "ce"), ("mask", "mask"), ("dice", "dice")]:
            stored = case.stored[f"criterion.{case.name}.loss_{released}{suffix}"]
            assert parts[part][row, 0].item() == pytest.approx(float(stored), abs=1e-4)

    weighted = criterion.compare(output, batch, case.draws())
    total = torch.stack(list(weighted.values())).sum()
    stored = case.stored[f"criterion.{case.name}.weighted_total"]
    assert total.item() == pytest.approx(float(stored), abs=1e-4)

    mask_gradient = torch.autograd.grad(total, output.aux["mask_logits"], retain_graph=True)[0]
    checks = {"grad_pred_masks.total": mask_gradient[-1, 0]}
    for part, tensor, key in [
        ("mask", "mask_logits", "grad_pred_masks.loss_mask"),
        ("dice", "mask_logits", "grad_pred_masks.loss_dice"),
        ("class", "class_logits", "grad_pred_logits.loss_ce"),
    ]:
        last = parts[part][-1, 0]
        checks[key] = torch.autograd.grad(last, output.aux[tensor], retain_graph=True)[0][-1, 0]
    for key, ours in checks.items():
        released = torch.from_numpy(case.stored[f"criterion.{case.name}.{key}"])
        assert torch.allclose(ours, released, rtol=0, atol=5e-7), key

    targets = targets_of(batch.label, tuple(case.recipe["image_size"]), 9, None)
    matches = criterion.match(*output.aux.values(), targets, case.draws())
    assert matches.label.tolist() == sum(case.recipe["target_classes"], [])
    for row, layer in enumerate(case.order):
        assert np.array_equal(matches.query[row], case.matches(layer))
