"""Scores become classes as `argmax` would make them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rgbt.class_scores import best_of, classes_of

DTYPES = (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8)


def first_highest(scores: Tensor) -> Tensor:
    """The first class with the highest score, one pixel after the other."""
    found = torch.empty((scores.shape[0], *scores.shape[2:]), dtype=torch.int64)
    for index in range(scores.shape[0]):
        for row in range(scores.shape[2]):
            for column in range(scores.shape[3]):
                values = scores[index, :, row, column].tolist()
                found[index, row, column] = values.index(max(values))
    return found


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("levels", [1, 2, 50])
def test_of_equal_scores_the_first_class_is_taken(dtype: torch.dtype, levels: int) -> None:
    draws = torch.Generator().manual_seed(levels)
    for shape in ((2, 9, 12, 17), (1, 1, 3, 2), (1, 40, 2, 3)):
        scores = torch.randint(levels, shape, generator=draws).to(dtype)
        for each in (scores, scores.flip(3), scores.contiguous(memory_format=torch.channels_last)):
            assert torch.equal(classes_of(each), first_highest(each))
            assert torch.equal(classes_of(each), each.argmax(1))


def test_best_has_the_score_of_its_class() -> None:
    scores = torch.tensor([[[[0.2, 3.0]], [[0.7, -1.0]], [[0.7, 3.0]]]])
    best = best_of(scores)
    assert best.classes.tolist() == [[[1, 0]]]
    assert torch.equal(best.score, torch.tensor([[[0.7, 3.0]]]))


def test_a_nan_is_not_hidden() -> None:
    scores = torch.tensor([1.0, float("nan"), float("inf"), float("nan")]).view(1, 4, 1, 1)
    assert classes_of(scores).item() == scores.argmax(1).item() == 1
    assert best_of(scores).score.isnan().all()
