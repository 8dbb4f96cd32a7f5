"""Show what this installation has: ``rgbt doctor``, to read, and to paste into a bug report.

Nothing is downloaded, sent or changed, no server is contacted, and passwords are hidden.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import Annotated

import rgbt
from rgbt.checks import InputError, one_line, without_controls
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.cores import usable_cores
from rgbt.files.atomic import cache_folder, check_writable

GB, PROBLEM = 1e9, "problem"

# Beginnings of the environment variables that change what rgbt does.
VARIABLES = (
    *(
        "RGBT_",
        "MLFLOW_",
        "CUDA_",
        "NVIDIA_",
        "PYTORCH_",
        "OMP_",
        "MKL_",
        "GOMP_",
        "KMP_",
        "TMPDIR",
    ),
    *("SLURM_JOB_ID", "XDG_CACHE_HOME", "PYTHONPATH", "VIRTUAL_ENV", "CONDA_PREFIX"),
)

# Names of variables whose whole value is hidden: it may have spaces.
SECRET = re.compile("PASS|SECRET|TOKEN|KEY|CRED")

# A line of our metadata: the name of a package, and the extra that needs it, if not all do.
REQUIREMENT = re.compile(r"([\w.-]+)(?:.*extra == ['\"]([\w-]+))?")

Lines = Iterator[tuple[str, str]]


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    runs_dir: Annotated[Path, Help("folder of runs")] = Path("runs")
    uri: Annotated[str, Help("address of an MLflow store, shown without its password")] = ""


def main(options: Options, _: list[str]) -> int:
    """Show Python, torch, GPU, disk, memory, MLflow store, folders, packages and extras.

    Exit code 1: a line begins with "problem".
    """
    code = 0
    for check in (machine, torch_build, packages, folders, store, variables):
        for name, text in _until_error(check, options):
            sys.stdout.write(without_controls(f"{name:<11} {text}\n"))
            code = code or int(name == PROBLEM)
    return code


def _until_error(check: Callable[[Options], Lines], options: Options) -> Lines:
    try:
        yield from check(options)
    except Exception as error:  # whatever is missing or broken is what is to be shown
        yield PROBLEM, f"{check.__name__}: {type(error).__name__}: {one_line(error)}"


def machine(_: Options) -> Lines:
    """Yield rgbt, Python, system, cores and memory, and which command the shell finds."""
    yield "rgbt", f"{rgbt.__version__} in {Path(rgbt.__file__).parent}"
    found = shutil.which("rgbt")
    yield "command", found or "the shell does not find rgbt; activate the environment"
    yield "python", f"{platform.python_version()} ({sys.executable})"
    yield "system", f"{platform.platform()}, {usable_cores()} of {os.cpu_count()} cores usable"
    if not hasattr(os, "sysconf"):  # Windows
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GB
    linux = Path("/proc/meminfo")
    free = re.search(r"MemAvailable: *(\d+)", linux.read_text()) if linux.exists() else None
    yield "memory", f"{memory:.1f} GB" + (f", {int(free[1]) / 1e6:.1f} GB free" if free else "")


def torch_build(_: Options) -> Lines:
    """Yield driver, build of torch and cards, and whether they fit each other."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    drivers: list[str] = []
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=30, check=True)
        drivers = done.stdout.splitlines()
        yield "driver", "; ".join(drivers)
    except FileNotFoundError:
        yield "driver", "no NVIDIA driver found"
    except (OSError, subprocess.SubprocessError) as error:
        yield "driver", f"nvidia-smi: {one_line(getattr(error, 'stdout', None) or error)}"
    torch = import_module("torch")
    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
    yield "torch", f"{torch.__version__}, {build}, {torch.get_num_threads()} threads"
    cards = torch.cuda.device_count() if torch.cuda.is_available() else 0
    for index in range(cards):
        of = torch.cuda.get_device_properties(index)
        yield f"GPU {index}", f"{of.name}, {of.total_memory / GB:.0f} GB, sm_{of.major}{of.minor}"
    if drivers and not torch.version.cuda:
        yield PROBLEM, "torch is a build without CUDA; see https://pytorch.org/get-started/locally/"
    elif drivers and not cards:
        yield PROBLEM, "torch sees no GPU: an old driver for its CUDA, or CUDA_VISIBLE_DEVICES"


def packages(_: Options) -> Lines:
    """Yield the versions of the packages that rgbt needs, and whether the extras are complete."""
    installed = {of.name.lower().replace("_", "-"): of.version for of in metadata.distributions()}
    by_extra: dict[str, list[str]] = {}
    for line in metadata.requires("rgbt") or []:
        name, extra = REQUIREMENT.findall(line)[0]
        by_extra.setdefault(extra, []).append(name.lower().replace("_", "-"))
    for extra, names in by_extra.items():
        missing = ", ".join(name for name in names if name not in installed)
        if extra:
            yield f"[{extra}]", f"not installed: {missing}" if missing else "installed"
            continue
        yield "packages", ", ".join(f"{name} {installed.get(name, '-')}" for name in names)
        if missing:
            yield PROBLEM, f"not installed: {missing}"


def folders(options: Options) -> Lines:
    """Yield the folders that are written to, and the free space of their disks."""
    paths = {"runs_dir": options.runs_dir, "cache": cache_folder()}
    paths["temporary"] = Path(tempfile.gettempdir())
    for name, path in paths.items():
        whole = path.absolute()
        there = next(place for place in (whole, *whole.parents) if place.exists())
        yield name, f"{whole}, {shutil.disk_usage(there).free / GB:.1f} GB free"
        try:
            check_writable(f"{name}={path}", path)
        except InputError as error:
            yield PROBLEM, str(error)


def store(options: Options) -> Lines:
    """Yield where MLflow keeps runs; a server is not contacted."""
    from rgbt.runs.provenance import without_passwords

    database = options.runs_dir.absolute() / "mlflow.db"
    local = f"{database}{'' if database.is_file() else ', made by the first run'}"
    yield "MLflow", f"{without_passwords(options.uri)}, not contacted" if options.uri else local


def variables(_: Options) -> Lines:
    """Yield the environment variables that change what rgbt does."""
    from rgbt.runs.provenance import HIDDEN, without_passwords

    for name in sorted(name for name in os.environ if name.startswith(VARIABLES)):
        own = ", rgbt's own value" if rgbt.WAITING.get(name) == os.environ[name] else ""
        value = HIDDEN if SECRET.search(name) else os.environ[name]
        yield "variable", without_passwords(f"{name}={value}") + own


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
