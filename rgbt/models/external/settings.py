"""Keep settings of the process that foreign code changes when it is imported or builds a network.

Authors' modules choose a GPU in the environment, a default type or the number of threads, or
change the working directory. Here these are settings of this project, and of the run key.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

CUDNN = ("enabled", "benchmark", "deterministic", "allow_tf32")
"""Settings of `torch.backends.cudnn`."""


@contextmanager
def kept_settings() -> Iterator[None]:
    """Afterwards the folder, the environment and the settings of torch are as before."""
    folder, environment = os.getcwd(), dict(os.environ)  # noqa: PTH109 - what chdir takes
    cudnn = {name: getattr(torch.backends.cudnn, name) for name in CUDNN}
    dtype, device = torch.get_default_dtype(), torch.get_default_device()
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    mode = torch.get_deterministic_debug_mode()
    records, detects = torch.is_grad_enabled(), torch.is_anomaly_enabled()
    try:
        yield
    finally:
        if torch.get_default_device() != device:
            torch.set_default_device(None)
        torch.autograd.set_detect_anomaly(detects)
        torch.set_grad_enabled(records)
        torch.set_deterministic_debug_mode(mode)
        torch.set_float32_matmul_precision(precision)
        if torch.get_num_threads() != threads:
            torch.set_num_threads(threads)
        torch.set_default_dtype(dtype)
        for name, value in cudnn.items():
            setattr(torch.backends.cudnn, name, value)
        for name in os.environ.keys() - environment.keys():
            del os.environ[name]
        os.environ.update(environment)
        os.chdir(folder)
