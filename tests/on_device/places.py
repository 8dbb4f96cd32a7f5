"""The device of the tests marked gpu: CUDA, or what RGBT_TEST_DEVICE names."""

from __future__ import annotations

import os

import pytest
import torch

NAME = os.environ.get("RGBT_TEST_DEVICE") or ("cuda" if torch.cuda.is_available() else "")
REASON = "needs a CUDA device; RGBT_TEST_DEVICE=cpu tries it on a CPU"
ON_DEVICE = [pytest.mark.gpu, pytest.mark.skipif(not NAME, reason=REASON)]


def device() -> torch.device:
    """The device, with its number."""
    return torch.device(NAME, 0) if NAME == "cuda" else torch.device(NAME)
