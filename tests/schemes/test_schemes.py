"""How the CRM step is made of passes and losses, checked with hand-made predictions."""

from __future__ import annotations

import weakref

import pytest
import torch
from torch import Tensor

from rgbt.data.domains import Domain, Domains
from rgbt.requirements import MaskerRecord
from rgbt.schemes.crm import CRM
from rgbt.schemes.supervised import Supervised
from rgbt.types import Batch, MaskPair, Output
from tests.losses.problems import batch_of

ONE = Domains(
    source=Domain(split="train", view=None, head=None, labels="given"),
    target=None,
    target_is=None,
    tested_head="own",
)
B, Q, K = 2, 3, 4


def batch() -> Batch:
    return batch_of(torch.zeros(B, 32, 32, dtype=torch.int64))


def generator_of(purpose: str) -> torch.Generator:
    return torch.Generator().manual_seed(len(purpose))


class Numbered:
    """Pass p predicts class logits that are all p; remembers how it was called."""

    def __call__(
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        passes: int = 1,
        views: tuple[str, ...] = ("rgbt",),
        num_predictions: int | None = None,
        num_masks: int | None = None,
        generator: torch.Generator | None = None,
    ) -> Output:
        count = num_predictions or passes * len(views)
        self.call = {"n": len(rgb), "masks": masks, "passes": passes, "views": views}
        self.call |= {"num_predictions": count, "num_masks": num_masks or count}
        logits = torch.arange(count, dtype=torch.float32).view(1, -1, 1, 1, 1)
        class_logits = logits.expand(2, count, B, Q, K + 1)
        mask_logits = class_logits[:, :num_masks, ..., None].contiguous()
        return Output(None, {"class_logits": class_logits, "mask_logits": mask_logits})


class OneEach:
    """Every pass has loss 1 + its index."""

    def __call__(self, output: Output, batch: Batch, generator: torch.Generator) -> dict:
        self.passes = output.aux["class_logits"].shape[1]
        assert output.aux["mask_logits"].shape[1] == self.passes
        return {"class": torch.arange(1.0, self.passes + 1)}


class Halves:
    def __call__(self, image_hw, centre_yx: Tensor, generator) -> MaskPair:
        hidden = torch.zeros(len(centre_yx), 2, 2, dtype=torch.bool)
        hidden[:, 0] = True
        return MaskPair(hidden, ~hidden)


class Nothing(Halves):
    record = MaskerRecord(hides_cells=False)


def scheme(masker: object, **weights: float) -> CRM:
    names = ("modality_weight", "complementary_weight", "nonlocal_weight")
    given = {name: weights.get(name, 1.0) for name in names}
    return CRM(model=Numbered(), loss=OneEach(), masker=masker, **given)


def test_full_step_weights_four_supervised_passes_and_two_distillations() -> None:
    crm = scheme(Halves(), modality_weight=0.5, complementary_weight=2.0, nonlocal_weight=3.0)
    (phase,) = crm.phases(batch(), generator_of)
    # Passes in order F R T F' R' T' are numbered 0..5; losses of the first four are 1 2 3 4.
    assert crm.loss.passes == 4
    assert phase.parts["class"] == 1 + 0.5 * 2 + 0.5 * 3 + 4
    assert phase.parts["sdc"] == 2.0 * 3  # |F - F'| = |0 - 3|
    assert phase.parts["sdn"] == 3.0 * (4 + 5)  # |F - R'| + |F - T'|


ALL = ("rgbt", "rgb", "thermal")


@pytest.mark.parametrize(
    ("hides", "off", "call", "expected"),
    [
        # Only the criterion reads masks; SDN reads the class logits of R' and T' alone.
        (True, (), (2, ALL, 6, 4), {"class": 1 + 2 + 3 + 4, "sdc": 3, "sdn": 4 + 5}),
        (True, ("nonlocal",), (2, ALL, 4, 4), {"class": 1 + 2 + 3 + 4, "sdc": 3}),
        (True, ("modality",), (2, ALL, 6, 4), {"class": 1 + 4, "sdc": 3, "sdn": 4 + 5}),
        (True, ("modality", "nonlocal"), (2, ALL[:1], 2, 2), {"class": 1 + 2, "sdc": 1}),
        (False, ("complementary", "nonlocal"), (1, ALL, 3, 3), {"class": 1 + 2 + 3}),
    ],
)
def test_only_what_is_read_is_predicted(
    hides: bool, off: tuple[str, ...], call: tuple[object, ...], expected: dict[str, int]
) -> None:
    crm = scheme(Halves() if hides else Nothing(), **{f"{name}_weight": 0.0 for name in off})
    (phase,) = crm.phases(batch(), generator_of)
    names = ("passes", "views", "num_predictions", "num_masks")
    assert tuple(crm.model.call[name] for name in names) == call
    assert phase.parts == expected


def test_the_clean_half_of_the_batch_is_not_masked() -> None:
    crm = scheme(Halves())
    list(crm.phases(batch(), generator_of))
    masks = crm.model.call["masks"]
    assert crm.model.call["n"] == 2 * B
    assert not masks.rgb[:B].any()
    assert not masks.thermal[:B].any()
    assert masks.rgb[B:].float().mean() == 0.5
    assert torch.equal(masks.rgb[B:], ~masks.thermal[B:])


def test_supervised_masks_its_pass_when_there_is_a_masker() -> None:
    supervised = Supervised(model=Numbered(), loss=OneEach(), masker=Halves(), domains=ONE)
    list(supervised.phases(batch(), generator_of))
    assert supervised.model.call["masks"].rgb.shape == (B, 2, 2)


@pytest.mark.parametrize("kind", ["crm", "supervised"])
def test_phase_does_not_keep_the_predictions(kind: str) -> None:
    """Of all accumulated batches, the predictions would exist at the same time."""
    kept: list[weakref.ref[Tensor]] = []

    class Watched(Numbered):
        def __call__(self, *arguments, **keywords) -> Output:
            output = super().__call__(*arguments, **keywords)
            kept.append(weakref.ref(output.aux["mask_logits"]))
            return output

    if kind == "crm":
        made = scheme(Halves())
        made.model = Watched()
    else:
        made = Supervised(model=Watched(), loss=OneEach(), masker=Halves(), domains=ONE)
    phases = made.phases(batch(), generator_of)
    phase = next(phases)
    assert phase.parts
    assert [predictions() for predictions in kept] == [None]
