"""Seeds of generators: by run, purpose and index, the same on every machine."""

from __future__ import annotations

import hashlib
from itertools import product

import torch

from rgbt.randomness import derive, generators_of_step, numpy_generator, torch_generator


def test_seed_is_of_all_its_parts() -> None:
    text = hashlib.sha256(b"3:mask:7:1").digest()
    assert derive(3, "mask", 7, 1) == int.from_bytes(text[:8], "big") // 2
    seeds = {derive(*each) for each in product((0, 1), ("mask", "order"), (0, 1, 10), (0, 1))}
    assert len(seeds) == 2 * 2 * 3 * 2


def test_generators_of_one_step_differ_by_purpose_alone() -> None:
    of_step = generators_of_step(3, 7, torch.device("cpu"))
    drawn = [torch.rand(2, generator=of_step(each)).tolist() for each in ("mask", "mask", "loss")]
    assert drawn[0] == drawn[1] == torch.rand(2, generator=torch_generator(3, "mask", 7)).tolist()
    assert drawn[0] != drawn[2]
    assert numpy_generator(3, "mask", 7).random() == numpy_generator(3, "mask", 7).random()
