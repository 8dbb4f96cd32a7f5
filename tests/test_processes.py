"""What the processes of a run share: sums, batch normalisation, loaders.

`tests/schemes/test_several.py` has what they draw.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from rgbt import processes
from rgbt.checks import InputError
from rgbt.data.loaders import LoaderSettings, PairedBatches, eval_batches, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.engine.batch_norm import (
    SynchronisedBatchNorm,
    check_batch_norm_parts,
    share_running_statistics,
    synchronise_batch_norm,
)
from tests.conftest import WriteMFNet
from tests.models.plain import generator
from tests.processes import run_in_processes
from tests.transforms.recipes import crm

SIZE = 2
B, DTYPES = 8, (torch.float32, torch.float32, torch.float64)
SPLITS = {"train": [f"{i:05d}D" for i in range(11)], "val": [f"{i:05d}N" for i in range(5)]}


@cache
def found_by_rank() -> list[dict[str, Any]]:
    """What each of the processes found, by rank."""
    return run_in_processes(everything, SIZE)


def everything() -> dict[str, Any]:
    return {**sharing(), **normalised(), "subclass": is_refused(renamed)}


def is_refused(work: Callable[[], Any]) -> bool:
    with suppress(InputError):
        work()
        return False
    return True


def sharing() -> dict[str, Any]:
    rank, size = processes.rank(), processes.num_processes()
    entries = torch.arange(2 * B).view(B, 2)
    part = torch.tensor([1.0, 2.0 + rank], requires_grad=True)
    total = processes.total(part)
    # Each process has a loss of its own in the sum: (rank + 1) * total^2.
    ((rank + 1) * total.square()).sum().backward()
    layout = torch.arange(B * 12).view(B, 2, 3, 2).contiguous(memory_format=torch.channels_last)
    return {
        "own": (processes.own(entries), processes.own(entries, 1)),
        "own_draw": processes.own_draw(lambda n: torch.arange(n), B // size),
        "whole": [
            torch.equal(processes.whole(processes.own(tensor)), tensor)
            for tensor in (entries, entries > 5, layout)
        ],
        "sums": (total.detach(), part.grad, processes.total(torch.tensor(rank))),
        "mean_count": processes.mean_count(torch.tensor(3 * rank)),
        "largest": processes.largest(5 - rank),
        "averaged": averaged(),
        "once": processes.computed_once(lambda: (rank, processes.num_processes())),
        "objects": processes.collected(("of", rank)),
    }


def averaged() -> list[float | None]:
    """Gradients of three parameters after `processes.average_gradients`."""
    parameters = [nn.Parameter(torch.zeros(2, dtype=dtype)) for dtype in DTYPES]
    for factor, parameter in zip((1, 0, 10), parameters, strict=True):
        parameter.grad = torch.full_like(parameter, factor * processes.rank()) if factor else None
    processes.average_gradients(parameters)
    return [
        None if parameter.grad is None else float(parameter.grad[1]) for parameter in parameters
    ]


@pytest.mark.slow
def test_parts_wholes_and_sums() -> None:
    entries = torch.arange(2 * B).view(B, 2)
    ranks = sum(range(SIZE))
    total = torch.tensor([float(SIZE), 2.0 * SIZE + ranks])
    for rank, found in enumerate(found_by_rank()):
        assert torch.equal(found["own"][0], entries[rank::SIZE])
        assert torch.equal(found["own"][1], entries[:, rank::SIZE])
        assert found["own_draw"].tolist() == list(range(rank, B, SIZE))
        assert all(found["whole"])
        # The gradient is of the sum of (rank + 1) * total^2 over all processes.
        expected = (total, 2 * total * (ranks + SIZE), torch.tensor(ranks))
        assert all(map(torch.equal, found["sums"], expected))
        assert found["mean_count"] == 3 * ranks / SIZE
        assert found["largest"] == 5
        # Of each parameter the mean of rank and of 10 rank; the one without a gradient has none.
        assert found["averaged"] == [ranks / SIZE, None, 10 * ranks / SIZE]
        assert found["once"] == (0, 1), "process 0 computes as if it were the only one"
        assert found["objects"] == [("of", other) for other in range(SIZE)]


def normalised() -> dict[str, Any]:
    """Two steps in training mode and one evaluation; gradients averaged over the processes."""
    torch.manual_seed(0)
    net = nn.Sequential(
        nn.Conv2d(3, 4, 3),
        nn.BatchNorm2d(4),
        nn.ReLU(),
        nn.Conv2d(4, 3, 1),
        nn.BatchNorm2d(3, momentum=None, affine=False),
        nn.Flatten(2),
        nn.BatchNorm1d(3, track_running_stats=False),
    ).double()
    names = list(net.state_dict())
    made = synchronise_batch_norm(net)
    images = [5 + torch.randn(B, 3, 5, 6, generator=generator(n)).double() for n in (1, 2)]
    weight = torch.randn(B, 3, 12, generator=generator(3)).double()
    outputs = [made(processes.own(batch)) for batch in images]
    for output in outputs:
        (output * processes.own(weight)).mean().backward()
    gradients = [processes.total(p.grad) / processes.num_processes() for p in made.parameters()]
    statistics = {name: buffer.clone() for name, buffer in made.named_buffers()}
    # Without the last one, which has no statistics to evaluate with.
    evaluated = made.eval()[:-1](processes.own(images[0])).detach()
    for buffer in made.buffers():  # as if every process had statistics of its own
        buffer.fill_(processes.rank() + 1)
    share_running_statistics(made)
    return {
        "outputs": [output.detach() for output in outputs],
        "gradients": gradients,
        "statistics": statistics,
        "evaluated": evaluated,
        "replaced": sum(isinstance(layer, SynchronisedBatchNorm) for layer in made),
        "same": names == list(made.state_dict()),
        "shared": [buffer.unique().tolist() for buffer in made.buffers()],
    }


def test_batch_norm_is_that_of_one_process() -> None:
    expected = normalised()
    close = partial(torch.testing.assert_close, rtol=1e-9, atol=1e-12)
    for rank, found in enumerate(found_by_rank()):
        for ours, every in zip(found["outputs"], expected["outputs"], strict=True):
            close(ours, every[rank::SIZE])
        close(found["gradients"], expected["gradients"])
        close(found["statistics"], expected["statistics"])
        close(found["evaluated"], expected["evaluated"][rank::SIZE])
        assert (found["replaced"], found["same"]) == (3, True)
        assert all(values == [1] for values in found["shared"])
    assert expected["replaced"] == 0


def test_running_variance_is_unbiased_by_hand() -> None:
    # Values 1 and 3: mean 2, variance 1, unbiased 2; momentum 0.1 from mean 0 and variance 1.
    norm = SynchronisedBatchNorm(1)
    found = norm(torch.tensor([[1.0], [3.0]]))
    torch.testing.assert_close(found, torch.tensor([[-1.0], [1.0]]) / (1 + 1e-5) ** 0.5)
    assert norm.running_mean.item() == pytest.approx(0.2)
    assert norm.running_var.item() == pytest.approx(0.9 + 0.2)
    assert norm.num_batches_tracked == 1
    assert norm(torch.tensor([[1.0], [3.0]]).bfloat16()).dtype == torch.bfloat16


def renamed() -> None:
    synchronise_batch_norm(nn.Sequential(type("OfUser", (nn.BatchNorm2d,), {})(3)))


def test_derived_normalisation_is_refused_in_several_processes() -> None:
    assert found_by_rank()[1]["subclass"]
    assert not is_refused(renamed)


def test_batch_norm_parts_are_one_or_number_of_devices() -> None:
    for parts, size in ((1, 1), (1, 4), (4, 4)):
        check_batch_norm_parts(parts, size)
    for parts, size in ((2, 1), (2, 4), (8, 4)):
        assert is_refused(partial(check_batch_norm_parts, parts, size))


def loaded(root: Path) -> dict[str, Any]:
    dataset, given = MFNet(root=root), LoaderSettings(4, 2, num_workers=0)
    uneven = replace(given, batch_size=5)
    train = [train_batches(dataset, "train", crm(), given, seed, range(1, 5)) for seed in (3, 4)]
    pairs = PairedBatches(*train, first=1, per_step=1)
    return {
        "train": [batch for pair in pairs for batch in (pair.source, pair.target)],
        "eval": [batch.name for batch in eval_batches(dataset, dataset.names("val"), crm(), given)],
        "uneven": is_refused(lambda: train_batches(dataset, "train", crm(), uneven, 0, range(1))),
    }


def test_each_process_loads_its_own_samples(write_mfnet: WriteMFNet) -> None:
    root = write_mfnet(SPLITS)
    expected = loaded(root)
    found = run_in_processes(loaded, SIZE, root)
    for rank, ours in enumerate(found):
        for part, batch in zip(ours["train"], expected["train"], strict=True):
            assert part.name == batch.name[rank::SIZE]
            assert torch.equal(part.rgb, batch.rgb[rank::SIZE])
            assert torch.equal(part.label, batch.label[rank::SIZE])
        assert ours["eval"] == expected["eval"][rank::SIZE]
        assert ours["uneven"]
    names = [name for ours in found for batch in ours["eval"] for name in batch]
    assert sorted(names) == SPLITS["val"]  # each once, although one process may have none
    assert not expected["uneven"]
