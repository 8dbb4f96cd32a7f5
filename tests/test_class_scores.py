"""Scores become classes as `argmax` would make them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rgbt.class_scores import best_of, classes_of

DTYPES = (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("levels", [1, 2, 50])
def test_of_equal_scores_the_first_class_is_taken(dtype: torch.dtype, levels: int) -> None:
    draws = torch.Generator().manual_seed(levels)
    for shape in ((2, 9, 12, 17), (1, 1, 3, 2), (1, 40, 2, 3)):
        scores = torch.randint(levels, shape, generator=draws).to(dtype)
        for view in (scores, scores.flip(3), scores.contiguous(memory_format=torch.channels_last)):
            is_best = (view == view.amax(1, keepdim=True)).numpy(force=True)
            assert np.array_equal(classes_of(view), is_best.argmax(1))  # the first that is True
            assert torch.equal(best_of(view)[0], view.amax(1))


def test_a_nan_is_not_hidden() -> None:
    scores = torch.tensor([1.0, float("nan"), float("inf"), float("nan")]).view(1, 4, 1, 1)
    assert classes_of(scores).item() == scores.argmax(1).item() == 1
    assert best_of(scores)[0].isnan().all()
