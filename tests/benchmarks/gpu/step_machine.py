"""The machine: names and versions, and the rates that others are compared with."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess

import torch

from tests.benchmarks.gpu.device import checked, matmul_rate, name_of, seconds_of
from tests.benchmarks.gpu.task import Task

PACKAGES = ("numpy", "lightning-fabric", "hydra-core", "optuna", "mlflow", "pytest", "triton")
MIB = 2**20


def measure(task: Task) -> None:
    """Write names, versions, rates of matrix products and of copies."""
    task.row(quantity="python", value=platform.python_version())
    task.row(quantity="torch", value=torch.__version__)
    task.row(quantity="CPU cores", value=len(os.sched_getaffinity(0)))
    for package in PACKAGES:
        task.row(quantity=package, value=_version(package))
    device = checked(task.device)
    task.row(quantity="device", value=name_of(device))
    if device.type == "cuda":
        _describe_gpu(task, device)
    rates = {}
    for name in ("fp32", "tf32", "bf16"):
        rates[name] = matmul_rate(device, name, small=task.smoke) / 1e12
        task.row(quantity=f"matrix product {name}, TFLOP/s", value=rates[name])
    copies = _copies(task, device)
    for name, rate in copies.items():
        task.row(quantity=f"{name}, GB/s", value=rate / 1e9)
    products = ", ".join(f"{name} {rate:.3g}" for name, rate in rates.items())
    task.headline(f"{name_of(device)}; TFLOP/s: {products}")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _describe_gpu(task: Task, device: torch.device) -> None:
    properties = torch.cuda.get_device_properties(device)
    values = {
        "GPUs": torch.cuda.device_count(),
        "memory, MiB": properties.total_memory // MIB,
        "free memory, MiB": torch.cuda.mem_get_info(device)[0] // MIB,
        "multiprocessors": properties.multi_processor_count,
        "compute capability": f"{properties.major}.{properties.minor}",
        "driver": _driver(),
        "CUDA of PyTorch": torch.version.cuda,
        "cuDNN": torch.backends.cudnn.version(),
        "bfloat16": torch.cuda.is_bf16_supported(),
        "TF32 in products by default": torch.backends.cuda.matmul.allow_tf32,
        "TF32 in convolutions by default": torch.backends.cudnn.allow_tf32,
    }
    for name, value in values.items():
        task.row(quantity=name, value=value)


def _driver() -> str:
    """Version of the driver; "unknown" where nvidia-smi does not say it."""
    words = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.split("\n")[0].strip() or "unknown"


def _copies(task: Task, device: torch.device) -> dict[str, float]:
    """Bytes per second: within the device (read and written), and between it and the host."""
    size = (8 if task.smoke else 256) * MIB
    there, other = (torch.empty(size, dtype=torch.uint8, device=device) for _ in range(2))
    rates = {"copy within the device": 2 * size / seconds_of(lambda: other.copy_(there), device, 5)}
    if device.type != "cuda":
        return rates
    host = torch.empty(size, dtype=torch.uint8)
    pinned = torch.empty(size, dtype=torch.uint8, pin_memory=True)
    pairs = {
        "host to device, pinned": (there, pinned),
        "host to device, pageable": (there, host),
        "device to host, pinned": (pinned, there),
    }
    for name, (to, of) in pairs.items():
        rates[name] = size / seconds_of(
            lambda to=to, of=of: to.copy_(of, non_blocking=True), device, 5
        )
    return rates
