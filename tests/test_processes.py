"""What the processes of a run share: draws, sums, batch normalisation, loaders."""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, distributed, nn

from rgbt import processes
from rgbt.checks import InputError
from rgbt.data.loaders import LoaderSettings, check_batch_size, eval_batches, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.data.pairs import PairedBatches
from rgbt.engine.batch_norm import (
    SynchronisedBatchNorm,
    check_batch_norm_parts,
    share_running_statistics,
    synchronise_batch_norm,
)
from rgbt.losses.points import Points
from rgbt.models.cmx.decoder import MlpDecoder
from rgbt.models.parts import drop_channels, keep_factors
from rgbt.schemes.masks import draw_masks
from rgbt.types import MaskPair
from tests.conftest import WriteMFNet
from tests.models.plain import generator
from tests.processes import run_in_processes
from tests.transforms.recipes import crm

SIZES = pytest.mark.parametrize("size", [2, pytest.param(4, marks=pytest.mark.slow)])
B = 8
CPU = torch.device("cpu")
SPLITS = {"train": [f"{i:05d}D" for i in range(11)], "val": [f"{i:05d}N" for i in range(5)]}


@cache
def of(size: int) -> list[dict[str, Any]]:
    """What each of the processes found, by rank."""
    return run_in_processes(everything, size)


def everything() -> dict[str, Any]:
    return {**sharing(), **draws(), **normalised(), "subclass": refused_subclass()}


# ---- functions of rgbt.processes --------------------------------------------------------------


def in_another_layout() -> Tensor:
    maps = torch.arange(B * 12).view(B, 2, 3, 2)
    return maps.contiguous(memory_format=torch.channels_last)


def sharing() -> dict[str, Any]:
    rank, size = processes.rank(), processes.num_processes()
    entries = torch.arange(2 * B).view(B, 2)
    part = torch.tensor([1.0, 2.0 + rank], requires_grad=True)
    total = processes.total(part)
    # Each process has a loss of its own in the sum: (rank + 1) * total^2.
    ((rank + 1) * total.square()).sum().backward()
    return {
        "rank": (rank, size),
        "own": (processes.own(entries), processes.own(entries, 1)),
        "own_draw": processes.own_draw(lambda n: torch.arange(n), B // size),
        "whole": processes.whole(processes.own(entries)),
        "whole bool": processes.whole(processes.own(entries > 5)),
        "whole of another layout": processes.whole(processes.own(in_another_layout())),
        "total": total.detach(),
        "total int": processes.total(torch.tensor(rank)),
        "gradient": part.grad,
        "mean_count": processes.mean_count(torch.tensor(3 * rank)),
        "agreed": processes.agreed({"rank": rank}),
        "collected": processes.collected(("of", rank)),
    }


@SIZES
def test_parts_and_wholes(size: int) -> None:
    entries = torch.arange(2 * B).view(B, 2)
    for rank, found in enumerate(of(size)):
        assert found["rank"] == (rank, size)
        assert torch.equal(found["own"][0], entries[rank::size])
        assert torch.equal(found["own"][1], entries[:, rank::size])
        assert found["own_draw"].tolist() == list(range(rank, B, size))
        assert torch.equal(found["whole"], entries)
        assert torch.equal(found["whole bool"], entries > 5)
        assert torch.equal(found["whole of another layout"], in_another_layout())
        assert found["agreed"] == {"rank": 0}
        assert found["collected"] == [("of", other) for other in range(size)]


@SIZES
def test_sums_and_their_gradient(size: int) -> None:
    ranks = sum(range(size))
    total = torch.tensor([size, 2.0 * size + ranks])
    # sum_r (r + 1) total^2 has the gradient 2 total sum_r (r + 1), in every process.
    gradient = 2 * total * (ranks + size)
    for found in of(size):
        assert torch.equal(found["total"], total)
        assert found["total int"] == ranks
        assert torch.equal(found["gradient"], gradient)
        assert found["mean_count"] == 3 * ranks / size


def test_one_process_gets_its_arguments_back() -> None:
    value = torch.ones(3, 2)
    for function in (processes.own, processes.whole, processes.total, processes.mean_count):
        assert function(value) is value
    assert processes.agreed(value) is value
    assert processes.collected(value) == [value]
    assert (processes.rank(), processes.num_processes()) == (0, 1)


# ---- draws ------------------------------------------------------------------------------------


class Noise:
    """A masker that knows nothing of processes."""

    def __call__(self, image_hw: Any, centre_yx: Tensor, generator: Any) -> MaskPair:
        rgb = torch.rand(len(centre_yx), 2, 3, generator=generator) < 0.5
        return MaskPair(rgb, (centre_yx[:, 0] > 3)[:, None, None] ^ rgb)


def draws() -> dict[str, Any]:
    """Of the own samples; each generator is read once more, to see that all are in step."""
    count = B // processes.num_processes()
    own = processes.own
    given = [generator(seed) for seed in range(5)]
    images = SimpleNamespace(
        rgb=torch.zeros(count, 3, 64, 96), centre_yx=own(torch.arange(2 * B).view(B, 2))
    )
    points = Points(given[3], device=CPU)
    # Target t belongs to sample t // 3 of the batch.
    kept = torch.arange(3 * B).view(B, 3)
    found = {
        "keep": keep_factors(torch.tensor([0.2, 0.5]), (2, count, 1), given[0], CPU, dim=1),
        "drop": drop_channels(torch.ones(count, 5, 1, 1), 0.5, given[1]),
        "masks": torch.stack(draw_masks(Noise(), images, given[2])),  # type: ignore[arg-type]
        "matcher": points.matcher(2, count, 5),
        "loss": points.loss(3, 3 * B, 7, own(kept).flatten()),
    }
    return {
        **{f"drawn {name}": value for name, value in found.items()},
        "generators": [torch.rand(1, generator=each).item() for each in given],
    }


@SIZES
def test_draws_are_those_of_one_process(size: int) -> None:
    expected = draws()
    dims = {"keep": 2, "drop": 0, "masks": 1, "matcher": 1}
    for rank, found in enumerate(of(size)):
        assert found["generators"] == expected["generators"]
        for name, dim in dims.items():
            every = expected[f"drawn {name}"]
            ours = every.index_select(dim, torch.arange(rank, B, size))
            assert torch.equal(found[f"drawn {name}"], ours), name
        of_sample = expected["drawn loss"].unflatten(1, (B, 3))
        assert torch.equal(found["drawn loss"], of_sample[:, rank::size].flatten(1, 2))


# ---- batch normalisation ------------------------------------------------------------------------


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 4, 3),
        nn.BatchNorm2d(4),
        nn.ReLU(),
        nn.Conv2d(4, 3, 1),
        nn.BatchNorm2d(3, momentum=None, affine=False),
        nn.Flatten(2),
        nn.BatchNorm1d(3, track_running_stats=False),
    )


def normalised() -> dict[str, Any]:
    """Two steps in training mode and one evaluation; gradients averaged over the processes."""
    net = network().double()
    names = list(net.state_dict())
    made = synchronise_batch_norm(net)
    images = [5 + torch.randn(B, 3, 5, 6, generator=generator(n)).double() for n in (1, 2)]
    weight = torch.randn(B, 3, 12, generator=generator(3)).double()
    outputs = [made(processes.own(each)) for each in images]
    for each in outputs:
        (each * processes.own(weight)).mean().backward()
    size = processes.num_processes()
    gradients = [processes.total(p.grad) / size for p in made.parameters()]
    statistics = {name: each.clone() for name, each in made.named_buffers()}
    # Without the last one, which has no statistics to evaluate with.
    evaluated = made.eval()[:-1](processes.own(images[0])).detach()
    for each in made.buffers():  # as if every process had statistics of its own
        each.fill_(processes.rank() + 1)
    share_running_statistics(made)
    return {
        "outputs": [each.detach() for each in outputs],
        "gradients": gradients,
        "statistics": statistics,
        "evaluated": evaluated,
        "replaced": [type(each).__name__ for each in made],
        "same": names == list(made.state_dict()),
        "shared": [each.unique().tolist() for each in made.buffers()],
        "decoder": decoder_eps(),
    }


def decoder_eps() -> list[float]:
    """Of CMX's decoder, which normalises with another eps in evaluation."""
    settings = {"dim": 4, "dropout": 0.0, "norm_eps": (1e-3, 1e-5)}
    decoder = synchronise_batch_norm(MlpDecoder((3, 4, 5, 6), 2, **settings))  # type: ignore[arg-type]
    return [decoder.train(mode).linear_fuse[1].eps for mode in (True, False)]  # type: ignore[union-attr]


@SIZES
def test_batch_norm_is_that_of_one_process(size: int) -> None:
    expected = normalised()
    close = {"rtol": 1e-9, "atol": 1e-12}
    for rank, found in enumerate(of(size)):
        for ours, every in zip(found["outputs"], expected["outputs"], strict=True):
            torch.testing.assert_close(ours, every[rank::size], **close)
        torch.testing.assert_close(found["gradients"], expected["gradients"], **close)
        torch.testing.assert_close(found["statistics"], expected["statistics"], **close)
        torch.testing.assert_close(found["evaluated"], expected["evaluated"][rank::size], **close)
        assert found["replaced"].count("SynchronisedBatchNorm") == 3
        assert found["same"]
        assert all(values == [1] for values in found["shared"])
        assert found["decoder"] == [1e-3, 1e-5]
    assert "SynchronisedBatchNorm" not in expected["replaced"]


def test_running_variance_is_unbiased_by_hand() -> None:
    # Values 1 and 3: mean 2, variance 1, unbiased 2; momentum 0.1 from mean 0 and variance 1.
    norm = SynchronisedBatchNorm(1)
    found = norm(torch.tensor([[1.0], [3.0]]))
    torch.testing.assert_close(found, torch.tensor([[-1.0], [1.0]]) / (1 + 1e-5) ** 0.5)
    assert norm.running_mean.item() == pytest.approx(0.2)
    assert norm.running_var.item() == pytest.approx(0.9 + 0.2)
    assert norm.num_batches_tracked == 1
    assert norm(torch.tensor([[1.0], [3.0]]).bfloat16()).dtype == torch.bfloat16
    with pytest.raises(ValueError, match="1 dimensions"):
        norm.eval()(torch.ones(3))


class Renamed(nn.BatchNorm2d):
    """A class of a user."""


def refused_subclass() -> str:
    try:
        synchronise_batch_norm(nn.Sequential(Renamed(3)))
    except InputError as error:
        return str(error)
    return ""


def test_a_derived_normalisation_is_refused_where_there_are_several_processes() -> None:
    assert "model: '0' is a Renamed" in of(2)[1]["subclass"]
    assert "trainer.batch_norm_parts=2" in of(2)[1]["subclass"]
    assert not refused_subclass()


def test_batch_norm_is_left_alone_with_one_process() -> None:
    net = network()
    before = deepcopy(net.state_dict())
    assert synchronise_batch_norm(net) is net
    share_running_statistics(net)
    assert type(net[1]) is nn.BatchNorm2d
    torch.testing.assert_close(net.state_dict(), before, rtol=0, atol=0)


@pytest.mark.parametrize(("parts", "size"), [(1, 1), (1, 4), (4, 4)])
def test_batch_norm_parts_that_fit(parts: int, size: int) -> None:
    check_batch_norm_parts(parts, size)


@pytest.mark.parametrize(
    ("parts", "size", "word"), [(2, 1, "1 device "), (2, 4, "1 or 4"), (8, 4, "is 8")]
)
def test_batch_norm_parts_that_do_not_fit(parts: int, size: int, word: str) -> None:
    with pytest.raises(InputError, match=word):
        check_batch_norm_parts(parts, size)


# ---- loaders ------------------------------------------------------------------------------------


def settings(batch_size: int = 4) -> LoaderSettings:
    return LoaderSettings(batch_size=batch_size, eval_batch_size=2, num_workers=0)


def loaded(root: Path) -> dict[str, Any]:
    dataset, given = MFNet(root=root), settings()
    train = [train_batches(dataset, "train", crm(), given, seed, range(1, 5)) for seed in (3, 4)]
    pairs = list(PairedBatches(*train, first=1, per_step=1))
    evaluated = list(eval_batches(dataset, "val", crm(), given))
    return {
        "train": [(each.source, each.target, each.step) for each in pairs],
        "eval": [batch.name for batch in evaluated],
        "indivisible": _refusal(dataset),
    }


def _refusal(dataset: MFNet) -> str:
    try:
        train_batches(dataset, "train", crm(), settings(batch_size=5), 0, range(1))
    except InputError as error:
        return str(error)
    return ""


@SIZES
def test_each_process_loads_its_own_samples(write_mfnet: WriteMFNet, size: int) -> None:
    root = write_mfnet(SPLITS)
    expected = loaded(root)
    found = run_in_processes(loaded, size, root)
    for rank, ours in enumerate(found):
        for (*own_batches, step), (*batches, same_step) in zip(
            ours["train"], expected["train"], strict=True
        ):
            assert step == same_step
            for part, batch in zip(own_batches, batches, strict=True):
                assert part.name == batch.name[rank::size]
                assert torch.equal(part.rgb, batch.rgb[rank::size])
                assert torch.equal(part.label, batch.label[rank::size])
        assert ours["eval"] == expected["eval"][rank::size]
        assert f"data.batch_size is 5, which {size} devices cannot share" in ours["indivisible"]
    names = [name for ours in found for batch in ours["eval"] for name in batch]
    assert sorted(names) == SPLITS["val"]  # each once, although one process may have none
    assert not expected["indivisible"]


def test_batch_that_processes_cannot_share_is_refused() -> None:
    check_batch_size(settings(batch_size=12), 4)
    with pytest.raises(InputError, match="batch_size to a multiple of 4, or trainer.devices to a"):
        check_batch_size(settings(batch_size=14), 4)


# ---- the helper of these tests ------------------------------------------------------------------


def failing() -> None:
    if processes.rank() == 1:
        raise ValueError("one of them")
    distributed.barrier()


def test_a_process_that_fails_ends_all_with_its_traceback() -> None:
    with pytest.raises(AssertionError, match="process 1 failed.*(.|\n)*ValueError: one of them"):
        run_in_processes(failing, 2)
