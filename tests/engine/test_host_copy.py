"""Copies on the host have the values of their time, and the memory of the copies before."""

from __future__ import annotations

import copy
import gc
import io
from collections import OrderedDict
from typing import Any

import psutil
import pytest
import torch
from torch import nn

from rgbt.engine.host_copy import Copies, copied, reserve
from tests.checkpoints.test_torch_files import same
from tests.on_device.places import NAME, ON_DEVICE

MIB = 2**20


def state(device: str = "cpu") -> dict[str, Any]:
    """What a run saves, with the tensors that are rare."""
    network = nn.Sequential(nn.Conv2d(4, 6, 3), nn.BatchNorm2d(6)).to(device)
    network = network.to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), betas=(0.5, 0.9))
    network(torch.ones(2, 4, 5, 5, device=device)).square().sum().backward()
    optimizer.step()
    rare = [torch.empty(0, 3), torch.tensor(True), torch.ones(3, 2, dtype=torch.bfloat16)]
    rare += [torch.ones(1, 3).expand(2, 3), torch.arange(12.0).view(3, 4)[:, ::2], torch.tensor(7)]
    rare = [tensor.to(device) for tensor in rare]
    return {"model": network.state_dict(), "main": optimizer.state_dict(), "rare": rare, "step": 3}


@pytest.mark.parametrize("device", ["cpu", pytest.param(NAME, marks=ON_DEVICE)])
def test_copy_has_values_of_its_time_in_memory_of_the_first(device: str) -> None:
    own, copies = state(device), Copies()
    reserve(own, copies)()
    places = {keys: held.data_ptr() for keys, held in copies.items()}
    for factor in (1, 2):
        expected = copy.deepcopy(own)
        held = copied(own, copies)
        for value in (*own["model"].values(), own["main"]["state"][0]["exp_avg"]):
            value.mul_(factor + 1)
        assert same(held, expected)
        assert held["main"]["param_groups"][0]["betas"] == (0.5, 0.9)
        assert isinstance(held["model"], OrderedDict)
        assert held["model"]._metadata == own["model"]._metadata  # type: ignore[attr-defined]
        assert {keys: tensor.data_ptr() for keys, tensor in copies.items()} == places
        assert all(tensor.device.type == "cpu" for tensor in copies.values())
        assert held["model"]["0.weight"].stride() == own["model"]["0.weight"].stride()


def test_copies_are_saved_as_large_as_what_they_copy() -> None:
    """Not with all of the memory that they share."""
    sizes = []
    own = {"a": torch.rand(1000), "b": torch.rand(10)}
    for value in (own, copied(own, {})):
        file = io.BytesIO()
        torch.save(value, file)
        sizes.append(file.tell())
    assert sizes[0] == sizes[1]


def test_what_comes_later_or_changes_its_shape_gets_memory() -> None:
    copies: Copies = {}
    first = {"a": torch.ones(3), "b": {"c": torch.ones(2)}}
    assert same(copied(first, copies), first)
    kept = copies["a",]
    second = {"a": torch.zeros(3), "b": {"c": torch.zeros(4), "d": torch.ones(1)}}
    assert same(copied(second, copies), second)
    assert copies["a",] is kept


def test_second_copy_allocates_nothing() -> None:
    own = {str(number): torch.rand(MIB) for number in range(32)}  # 128 MiB
    copies: Copies = {}
    process = psutil.Process()
    reserve(own, copies)()
    copied(own, copies)
    gc.collect()
    before = process.memory_info().rss
    for _ in range(3):
        copied(own, copies)
    assert process.memory_info().rss - before < 8 * MIB
