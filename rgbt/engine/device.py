"""How a network computes, but not what: device, precision, threads, memory, compilation.

Only a training opens Lightning Fabric (`rgbt.engine.fabric`), which takes a second to import.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import shutil
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.util import find_spec
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from rgbt.checks import InputError
from rgbt.engine.settings import Precision, TrainerSettings
from rgbt.requirements import NetworkRecord, record_of

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
# `trainer.compile` -> mode of torch.compile. With CUDA graphs, the passes of one step would
# overwrite each other's results.
MODES = {"default": "default", "max-autotune": "max-autotune-no-cudagraphs"}


def choose_device(trainer: TrainerSettings) -> torch.device:
    """Choose the device of one process; "auto" prefers a GPU. InputError: there is none."""
    found = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    kinds = [*(kind for kind, is_there in found.items() if is_there), "cpu"]
    kind = kinds[0] if trainer.accelerator == "auto" else trainer.accelerator
    if kind not in kinds:
        raise InputError(f"trainer.accelerator: this machine has no {kind}, only {kinds}.")
    return torch.device("cpu") if kind == "cpu" else torch.device(kind, 0)


def set_matmul_precision(device: torch.device, trainer: TrainerSettings) -> None:
    """Let CUDA compute float32 products and convolutions in TF32, or not; a CPU is left as it is.

    These are the settings of torch before 2.9, which later versions know: once `fp32_precision` is
    set, torch.compile and Lightning fail, which read the old ones. `set_float32_matmul_precision`
    would change the CPU, too.
    """
    if device.type == "cuda":
        in_tf32 = trainer.matmul_precision == "high"
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = in_tf32


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[Any]:
    """Return the context of a forward pass on a device."""
    if precision == "32-true":
        return nullcontext()
    return torch.autocast(device.type, dtype=torch.bfloat16)


def fix_threads(num_threads: int) -> None:
    """Compute with this number of threads, >= 1: sums of other parts round to other bits.

    OMP_NUM_THREADS, MKL_NUM_THREADS, MKL_DYNAMIC and fewer cores (taskset, a cluster's job) have no
    effect after this call. InputError: OpenMP may take fewer, and torch would wait for ever.
    """
    limit = os.environ.get("OMP_THREAD_LIMIT", "")
    is_limited = limit.isdecimal() and int(limit) < num_threads
    if is_limited or os.environ.get("OMP_DYNAMIC", "").strip().lower() == "true":
        name = "OMP_THREAD_LIMIT" if is_limited else "OMP_DYNAMIC"
        raise InputError(f"trainer.threads={num_threads}: unset {name}={os.environ[name]}.")
    torch.set_num_threads(num_threads)


def keep_memory() -> None:
    """Tell glibc to keep freed tensors instead of giving their pages back to the kernel.

    Adding 1 to a tensor of 40 MB took 28.5 ms, and 6 ms with this setting; up to 30 % more memory
    is resident. Must run before torch allocates.
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL("libc.so.6")
        # Large blocks are not mapped one by one, and the heap is not trimmed.
        libc.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def place(network: nn.Module, device: torch.device, settings: TrainerSettings) -> nn.Module:
    """Move a network to `device`; convolutions with kernels in "channels_last" return such maps."""
    if settings.memory_format == "contiguous":
        return network.to(device)
    moved: nn.Module = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return moved


def prepare_training(network: nn.Module, settings: TrainerSettings) -> None:
    """Recompute the activations of a network or compile its forward, in place.

    The keys of its state do not change, and evaluation uses the network as it is.
    """
    if settings.activation_checkpointing and settings.compile in MODES:
        raise InputError("trainer.activation_checkpointing: cannot be used with trainer.compile.")
    if settings.activation_checkpointing:
        recompute_activations(network)
    if settings.compile in MODES:
        # The graph recomputes what these functions keep per size, which costs little.
        warnings.filterwarnings("ignore", message=r"(?s).*lru_cache", category=UserWarning)
        object.__setattr__(network, "forward", TrainingForward(network, MODES[settings.compile]))


def compiles_functions(settings: TrainerSettings, device: torch.device) -> bool:
    """Whether a training on `device` compiles the functions that `rgbt.fusion` marks."""
    if settings.compile != "auto":
        return settings.compile == "functions"
    compiler = os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
    return device.type == "cuda" and compiler is not None and find_spec("triton") is not None


def recompute_activations(network: nn.Module) -> None:
    """Compute activations of the modules in `Record.recomputed`, which draw nothing, again."""
    declared = record_of(network, NetworkRecord).recomputed
    pattern = "|".join(re.escape(names).replace(r"\*", "[^.]*") for names in declared)
    modules = []
    for name, module in network.named_modules():
        if name and re.fullmatch(pattern, name):
            modules.append(module)
    if not modules:
        raise InputError(
            "trainer.activation_checkpointing: the network has no module that the record of "
            f'{type(network).__name__} declares; write recomputed=("blocks.*",) there.'
        )
    for module in modules:
        object.__setattr__(module, "forward", TrainingForward(module))


class TrainingForward:
    """Calls the forward of a module: in training compiled or computed twice, else as it is.

    In training without a `mode` of torch.compile, it keeps its inputs alone, and is computed again
    in the backward pass. A copy of the module has a copy of it (therefore it is no function).
    """

    def __init__(self, module: nn.Module, mode: str | None = None) -> None:
        self.module, self.forward = module, module.forward
        self.compiled = None if mode is None else torch.compile(module.forward, mode=mode)

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Call the forward; the first call in training compiles it."""
        if not (self.module.training and torch.is_grad_enabled()):
            return self.forward(*arguments, **keywords)
        if self.compiled is not None:
            return self.compiled(*arguments, **keywords)
        return checkpoint(
            self.forward,
            *arguments,
            use_reentrant=False,
            preserve_rng_state=False,
            context_fn=lambda: (nullcontext(), _keeping_buffers(self.module)),
            **keywords,
        )


@contextmanager
def _keeping_buffers(module: nn.Module) -> Iterator[None]:
    """Let buffers be copies: only the first forward updates running statistics."""
    kept = []
    for part in module.modules():
        for name, buffer in part.named_buffers(recurse=False):
            kept.append((part, name, buffer))
    for part, name, buffer in kept:
        setattr(part, name, buffer.clone())
    try:
        yield
    finally:
        for part, name, buffer in kept:
            setattr(part, name, buffer)
