"""Timing, memory and switches of the device that is measured."""

from __future__ import annotations

import gc
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median

import torch

from tests.benchmarks.gpu.task import SkippedError


def checked(kind: str) -> torch.device:
    """The device of a kind, "cuda" or "cpu", started where it needs a start.

    Raises:
        SkippedError: PyTorch sees no GPU.
    """
    if kind == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        built = torch.version.cuda
        why = "no GPU is visible" if built else f"PyTorch {torch.__version__} is built without CUDA"
        raise SkippedError(f"it needs a GPU, but {why}.")
    torch.cuda.init()
    return torch.device("cuda", torch.cuda.current_device())


def name_of(device: torch.device) -> str:
    """The model of a GPU, or "CPU"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"


def wait(device: torch.device) -> None:
    """Return when the device has done what was requested of it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def seconds_of(call: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Median wall seconds of a call, after one that does not count."""
    call()
    times = []
    for _ in range(repeats):
        wait(device)
        began = time.perf_counter()
        call()
        wait(device)
        times.append(time.perf_counter() - began)
    return median(times)


@contextmanager
def arithmetic(name: str) -> Iterator[None]:
    """Whether float32 products may use TF32: "tf32" lets them, everything else does not.

    PyTorch's own default is neither: TF32 in convolutions, float32 in matrix products. The older
    names of the two switches are used, because every version from 2.0 on has them, and reading
    them fails after only the newer ones (`fp32_precision`) were set.
    """
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    before = matmul.allow_tf32, cudnn.allow_tf32
    matmul.allow_tf32 = cudnn.allow_tf32 = name == "tf32"
    try:
        yield
    finally:
        matmul.allow_tf32, cudnn.allow_tf32 = before


def reset_peak(device: torch.device) -> None:
    """Free what nobody uses, and start to count the peak anew."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def peak_mib(device: torch.device) -> float:
    """Peak of the memory that tensors took since `reset_peak`; on a CPU, of the process so far."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def matmul_rate(device: torch.device, name: str, *, small: bool) -> float:
    """Floating-point operations per second of a square matrix product.

    Args:
        device: where.
        name: "fp32", "tf32", "bf16" or "fp16".
        small: a product of a few milliseconds on a CPU.
    """
    side = 512 if small else 8192 if device.type == "cuda" else 1024
    dtype = {"bf16": torch.bfloat16, "fp16": torch.float16}.get(name, torch.float32)
    one, other = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    out = torch.empty(side, side, device=device, dtype=dtype)
    repeats = 3 if small else 10

    def products() -> None:
        for _ in range(repeats):
            torch.matmul(one, other, out=out)

    with arithmetic(name), torch.inference_mode():
        return repeats * 2 * side**3 / seconds_of(products, device, 3)
