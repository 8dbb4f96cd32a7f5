"""The device of the tests marked gpu: CUDA, or what RGBT_TEST_DEVICE names."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import torch

NAME = os.environ.get("RGBT_TEST_DEVICE") or ("cuda" if torch.cuda.is_available() else "")
REASON = "needs a CUDA device; RGBT_TEST_DEVICE=cpu tries it on a CPU"
ON_DEVICE = [pytest.mark.gpu, pytest.mark.skipif(not NAME, reason=REASON)]


def device() -> torch.device:
    """The device, with its number."""
    return torch.device(NAME, 0) if NAME == "cuda" else torch.device(NAME)


@pytest.fixture
def exact() -> Iterator[None]:
    """Products and convolutions in float32: TF32 differs from the CPU by 1e-3."""
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    before = matmul.allow_tf32, cudnn.allow_tf32
    matmul.allow_tf32 = cudnn.allow_tf32 = False
    yield
    matmul.allow_tf32, cudnn.allow_tf32 = before
