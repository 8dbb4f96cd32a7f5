"""The set criterion against the released one, on stated draws (reference material)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rgbt.losses.set_criterion import targets_of
from rgbt.types import Output
from tests.benchmarks.reference_criterion import Replayed
from tests.losses.problems import batch_of, criterion_of, recorded_losses
from tests.models.golden import requires_golden

pytestmark = requires_golden


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

    def draws(
        self,
    ) -> Any:
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


@pytest.fixture(params=["two_images", "one_empty_image"])
def case(request: pytest.FixtureRequest) -> Golden:
    return Golden(request.param)


def test_released_values(case: Golden) -> None:
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


def test_released_matches(case: Golden) -> None:
    output, label = case.output(), case.label()
    hw = case.recipe["image_size"]
    targets = targets_of(batch_of(label).label, tuple(hw), 9, None)
    criterion = criterion_of(num_classes=9, num_points=256)
    matches = criterion.match(output.aux["class_logits"], output.aux["mask_logits"], targets, case.draws())
    assert matches.label.tolist() == sum(case.recipe["target_classes"], [])
    for row, layer in enumerate(case.order):
        assert np.array_equal(matches.query[row], case.matches(layer))
