"""Threads, precision of products, recomputed activations, memory format, compiled forward."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.engine.checkpoint import restore_optimizer
from rgbt.engine.device import (
    TrainingForward,
    fix_threads,
    place,
    prepare_training,
    set_matmul_precision,
)
from rgbt.engine.optimizers import AdamW
from rgbt.engine.settings import TrainerSettings
from rgbt.requirements import NetworkRecord
from tests.engine.test_trainer import ADAMW, SETTINGS
from tests.models.plain import generator, images, nano

CPU = torch.device("cpu")
ALL_VIEWS = ("rgbt", "rgb", "thermal")
DROPS = {"drop_path_rate": 0.4}
CASES: list[Any] = [
    *((name, {}) for name in ("mfnet", "rtfnet", "pspnet", "deeplabv2", "dinov2")),
    *((name, {**DROPS, "decoder_dropout": 0.3}) for name in ("cmx", "cmnext")),
    *(("mask2former", changes) for changes in (DROPS, {**DROPS, "share_start": 2})),
    ("dinov2", {"tuning": "lora"}),
]
ONE_EACH = ("mfnet", "rtfnet", "pspnet", "deeplabv2", "cmx", "cmnext", "mask2former")


def settings(**changes: Any) -> TrainerSettings:
    return TrainerSettings(**{**SETTINGS, **changes})  # type: ignore[arg-type]


def recomputing(name: str, **changes: Any) -> nn.Module:
    net = nano(name, **changes)
    prepare_training(net, settings(activation_checkpointing=True))
    return net


def loss_of(net: nn.Module, step: int, *, dtype: torch.dtype | None = None) -> Tensor:
    """Two forward passes before one backward pass, as with two frames or two domains."""
    options = {"views": ALL_VIEWS, "passes": 2} if net.record.outputs == "masks" else {}
    parts = []
    for part in range(2):
        with torch.autocast("cpu", dtype or torch.bfloat16, enabled=dtype is not None):
            out = net(*images(2, seed=2 * step + part), generator=generator(step), **options)
        tensors = [*out.aux.values(), *([] if out.logits is None else [out.logits])]
        parts += [tensor.float().square().mean() + tensor.float().mean() for tensor in tensors]
    return torch.stack(parts).sum()


def trained(net: nn.Module, steps: int = 2, dtype: torch.dtype | None = None) -> list[Tensor]:
    """Losses and gradients of every step, then the state with the running statistics."""
    optimizer = torch.optim.SGD(net.parameters(), lr=1e-3)
    found = []
    for step in range(steps):
        optimizer.zero_grad()
        loss = loss_of(net.train(), step, dtype=dtype)
        loss.backward()
        found += [loss.detach(), *(p.grad.clone() for p in net.parameters() if p.grad is not None)]
        optimizer.step()
    return [*found, *net.state_dict().values()]


def kept_bytes(net: nn.Module) -> int:
    """Of the tensors that a forward pass keeps for the backward pass, without parameters."""
    own = {parameter.data_ptr() for parameter in net.parameters()}
    kept: dict[int, Tensor] = {}

    def keep(tensor: Tensor) -> Tensor:
        kept.setdefault(tensor.untyped_storage().data_ptr(), tensor)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        loss_of(net.train(), 0)
    return sum(t.untyped_storage().nbytes() for at, t in kept.items() if at not in own)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "dtype"),
    [*((*case, None) for case in CASES), ("mask2former", {}, torch.bfloat16)],
)
def test_recomputed_activations_give_the_same_bits(
    name: str, changes: dict[str, Any], dtype: torch.dtype | None
) -> None:
    plain, net = nano(name, **changes), recomputing(name, **changes)
    assert list(net.state_dict()) == list(plain.state_dict())
    pairs = zip(trained(plain, dtype=dtype), trained(net, dtype=dtype), strict=True)
    assert all(torch.equal(expected, found) for expected, found in pairs)
    assert plain.eval()(*images(1)).logits.equal(net.eval()(*images(1)).logits)


@pytest.mark.parametrize("name", ONE_EACH)
def test_recomputed_activations_are_not_kept(name: str) -> None:
    assert kept_bytes(recomputing(name)) < 0.7 * kept_bytes(nano(name))


def test_recomputation_leaves_the_buffers_of_the_network() -> None:
    net = recomputing("rtfnet")
    before = {name: id(buffer) for name, buffer in net.named_buffers()}
    loss_of(net.train(), 0).backward()
    assert {name: id(buffer) for name, buffer in net.named_buffers()} == before
    counts = {int(b) for name, b in net.named_buffers() if name.endswith("num_batches_tracked")}
    assert counts == {2}  # forward passes


def own(*recomputed: str) -> nn.Module:
    """A user's network."""
    net = nn.ModuleDict({"blocks": nn.Sequential(nn.Linear(3, 3), nn.Linear(3, 3))})
    net.record = NetworkRecord(recomputed=recomputed)
    return net


@pytest.mark.parametrize(
    ("recomputed", "changes", "words"),
    [
        ((), {}, "record of ModuleDict"),
        (("layers.*",), {}, "record of ModuleDict"),
        (("blocks.*",), {"compile": "default"}, "cannot be used with trainer.compile"),
    ],
)
def test_recomputation_that_is_impossible_is_refused(recomputed, changes, words: str) -> None:
    net = own("blocks.*")  # a star stands for one part of a name
    prepare_training(net, settings(activation_checkpointing=True))
    found = [isinstance(module.forward, TrainingForward) for module in net.modules()]
    assert found == [False, False, True, True]
    with pytest.raises(InputError, match=f"activation_checkpointing: .*{words}"):
        prepare_training(own(*recomputed), settings(activation_checkpointing=True, **changes))


@pytest.mark.parametrize("name", ["mfnet", "rtfnet", "pspnet", "deeplabv2", "cmx", "cmnext"])
def test_channels_last_differs_by_rounding_alone(name: str) -> None:
    plain = nano(name).double()
    net = place(copy.deepcopy(plain), CPU, settings(memory_format="channels_last"))
    rgb, thermal = (image.double() for image in images(2))
    first, second = (model.train()(rgb, thermal, generator=generator()) for model in (plain, net))
    torch.testing.assert_close(second.logits, first.logits, rtol=1e-9, atol=1e-11)
    assert any(
        parameter.is_contiguous(memory_format=torch.channels_last) and not parameter.is_contiguous()
        for parameter in net.parameters()
        if parameter.dim() == 4
    )


@pytest.mark.parametrize("formats", [("contiguous", "channels_last"), ("channels_last",) * 2])
def test_resumed_optimizer_has_the_layout_of_the_network(formats: tuple[str, str]) -> None:
    """A fused optimizer reads parameter and moments in the order of memory."""

    def start(memory_format: str) -> tuple[nn.Module, torch.optim.Optimizer]:
        net = place(nano("rtfnet"), CPU, settings(memory_format=memory_format))
        return net, AdamW(**ADAMW)(net)

    def step(net: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        for number, parameter in enumerate(net.parameters()):
            drawn = torch.randn(parameter.shape, generator=generator(number))
            parameter.grad = torch.empty_like(parameter).copy_(drawn)
        optimizer.step()

    straight, resumed = start(formats[0]), start(formats[1])
    step(*straight)
    resumed[0].load_state_dict(straight[0].state_dict())
    stored = copy.deepcopy(straight[1].state_dict())
    for state in stored["state"].values():  # a checkpoint may come from another memory format
        state.update({k: v.contiguous() for k, v in state.items() if isinstance(v, Tensor)})
    restore_optimizer(resumed[1], stored, None)  # type: ignore[arg-type]
    step(*straight)
    step(*resumed)
    for expected, found in zip(straight[0].parameters(), resumed[0].parameters(), strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "changes"), CASES[:1])
def test_compiled_steps_give_the_same_losses(name: str, changes: dict[str, Any]) -> None:
    torch._dynamo.reset()
    plain, net = nano(name, **changes), nano(name, **changes)
    prepare_training(net, settings(compile="default"))
    assert list(net.state_dict()) == list(plain.state_dict())
    for expected, found in zip(trained(plain), trained(net), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)


@pytest.fixture
def kept_threads() -> Any:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("kept_threads")
def test_fix_threads_does_not_depend_on_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    for num_threads in (1, 3):
        fix_threads(num_threads)
        assert torch.get_num_threads() == num_threads
    for name, ends, fits in (("OMP_DYNAMIC", "TRUE", "false"), ("OMP_THREAD_LIMIT", "1", "2")):
        monkeypatch.setenv(name, fits)
        fix_threads(2)
        monkeypatch.setenv(name, ends)
        with pytest.raises(InputError, match=rf"trainer.threads=2: unset {name}={ends}"):
            fix_threads(2)
        monkeypatch.delenv(name)


@pytest.fixture
def kept_precision() -> Any:
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    before = matmul.allow_tf32, cudnn.allow_tf32
    yield
    matmul.allow_tf32, cudnn.allow_tf32 = before


def in_tf32() -> tuple[bool, ...]:
    """Products and convolutions of CUDA, then those of the CPU's library (torch 2.9 and later)."""
    matmul, cudnn, cpu = torch.backends.cuda.matmul, torch.backends.cudnn, torch.backends.mkldnn
    of_cpu = [getattr(cpu, name, None) for name in ("matmul", "conv")]
    reduced = [getattr(part, "fp32_precision", "none") != "none" for part in of_cpu]
    return (matmul.allow_tf32, cudnn.allow_tf32, *reduced)


@pytest.mark.usefixtures("kept_precision")
def test_matmul_precision_changes_cuda_alone() -> None:
    for device, name, expected in (
        ("cuda", "highest", (False, False)),
        ("cpu", "high", (False, False)),
        ("cuda", "high", (True, True)),
        ("cpu", "highest", (True, True)),
    ):
        set_matmul_precision(torch.device(device, 0), settings(matmul_precision=name))
        assert in_tf32() == (*expected, False, False)
        # What torch.compile and Lightning read.
        assert torch.get_float32_matmul_precision() == ("high" if expected[0] else "highest")
