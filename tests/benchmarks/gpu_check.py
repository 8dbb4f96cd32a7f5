"""What one card does with CRM at paper size, in at most six minutes: ``make gpu-check``.

Rows are measured in the order of their importance, each in a process of its own, so that an error
or a time limit costs one row. The table is printed as it grows; everything is in the JSON file.

Run: python -m tests.benchmarks.gpu_check [minutes=6] [release=CHECKOUT] [network=swin_s]
     [out=gpu-check.json] [rows=tf32,fp32] [device=cpu: a tiny network, to try this script]
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

# What the rows of `gpu_step` are, and "tests"; the first ones matter most.
ROWS = {
    "tf32": "TF32 (default)",
    "fp32": "float32 (matmul_precision=highest)",
    "bf16": "bf16-mixed, TF32",
    "bf16_decoder": "bf16-mixed, pixel decoder too",
    "release": "TF32, beside the release",
    "eager": "TF32, compile=none",
    "tests": "",
    "loader_cache": "TF32, 4 loaders, decoded cache",
    "loader_files": "TF32, 4 loaders, files",
    "recomputed": "TF32, activation_checkpointing",
    "not_fused": "TF32, AdamW not fused",
    "compiled": "TF32, compile=default",
}
TESTS = {"cuda": "tests/on_device", "cpu": "tests/on_device/test_draws.py"}
TESTS_S, LEAST_S = 90.0, 10.0  # limit of the tests, and what a row needs at least

# Dense TFLOP/s of cards as NVIDIA prints them: in TF32, in bf16.
PEAKS = {
    "H100 80GB HBM3*": (494.7, 989.4),
    "H200*": (494.7, 989.4),
    "GH200*": (494.7, 989.4),
    "H100 NVL*": (417.5, 835.5),
    "H100 PCIe*": (378.0, 756.0),
    "A100*": (156.0, 312.0),
    "A40*": (74.8, 149.7),
    "L40S*": (183.0, 362.0),
    "RTX A6000*": (77.4, 154.8),
    "GeForce RTX 4090": (82.6, 165.2),
    "GeForce RTX 3090": (35.6, 71.2),
}
COLUMNS = ("images/s", "ms a step", "longest ms", "peak MiB", "loss", "waiting", "share of peak")


def in_process(words: list[str], limit_s: float, **variables: str) -> tuple[int | None, str, str]:
    """Exit code (None: it took longer), output and messages of ``python -m words``."""
    process = subprocess.Popen(
        [sys.executable, "-m", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **variables},
        start_new_session=True,
    )
    try:
        out, err = process.communicate(timeout=limit_s)
        return process.returncode, out, err
    except subprocess.TimeoutExpired:
        return None, "", ""
    finally:  # with its loaders and compilers
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def run_tests(device: str, limit_s: float) -> dict[str, Any]:
    """Outcome of the tests marked gpu."""
    words = ["pytest", "-m", "gpu and not slow", TESTS[device]]
    code, out, _ = in_process(words, limit_s, RGBT_TEST_DEVICE=device)
    if code is None:
        return {"failed": f"not finished after {limit_s:.0f} s"}
    outcome = out.strip().splitlines()[-1].strip("= ") if out.strip() else f"exit code {code}"
    return {"failed" if code else "outcome": outcome}


def run_row(row: str, request: list[str], limit_s: float) -> dict[str, Any]:
    """Figures of a row, or why there are none."""
    code, out, err = in_process(["tests.benchmarks.gpu_step", row, *request], limit_s)
    if code is None:
        return {"failed": f"not finished after {limit_s:.0f} s"}
    if code:
        return {"failed": (err.strip().splitlines() or [f"exit code {code}"])[-1][:300]}
    found: dict[str, Any] = json.loads(out.splitlines()[-1])
    return found


def share_of_peak(row: str, found: dict[str, Any], rows: dict[str, dict[str, Any]]) -> str:
    """Operations of a step over its time, as a share of what the card can do, or "unknown"."""
    flops = rows.get("tf32", {}).get("flops")
    names = found["machine"]["gpus"]
    for pattern, peaks in PEAKS.items():
        if flops and names and fnmatch(names[0].removeprefix("NVIDIA "), pattern):
            rate = flops / found["ms a step"] / 1e9
            return f"{100 * rate / peaks[row.startswith('bf16')]:.1f} %"
    return "unknown"


def line(title: str, found: dict[str, Any]) -> str:
    """A row of the table."""
    if "failed" in found:
        return f"| {title} | not measured: {found['failed']} |"
    cells = []
    for name in COLUMNS:
        value = found.get(name, "")
        cells.append(value if isinstance(value, str) else f"{value:.4g}")
    return f"| {title} | {' | '.join(cells)} |"


def examined(found: dict[str, Any]) -> str:
    """What one step executes."""
    lines = [f"\n{name}: {text}" for name, text in found.items() if name.endswith(" failed")]
    if "flops" in found:
        lines.append(f"\nA step has {found['flops'] / 1e12:.3g} TFLOP.")
    if "top" not in found:
        return "\n".join(lines)
    lines.append(f"\nIt is {found['kernels']} kernels and copies in {found['kernel ms']:.4g} ms:\n")
    lines += ["| kernel | ms | calls |", "|---|---|---|"]
    for kernel in found["top"]:
        lines.append(f"| `{kernel['name'][:90]}` | {kernel['ms']:.3g} | {kernel['calls']} |")
    return "\n".join(lines)


def about(device: str, found: dict[str, Any]) -> str:
    """Machine, versions, code and network of the figures."""
    at = found["machine"]
    name = at["gpus"][0] if device == "cuda" else at["cpu"]
    versions = f"torch {at['torch']}, CUDA {at['cuda']}, Python {at['python']}"
    commit = f"{str(at['git_commit'])[:10]}{'+' if at['git_dirty'] else ''}"
    network = f"{at['network']} of {at['parameters'] / 1e6:.4g} M parameters"
    return f"\n{name}, {versions}, commit {commit}; {network}, batch {found['batch']}."


def main(words: list[str]) -> int:
    """Measure until the time is over; 1: something failed, 2: there is no card."""
    given = dict(word.split("=", 1) for word in words)
    began, limit_s = time.monotonic(), 60 * float(given.get("minutes", 6.0))
    device, network = given.get("device", "cuda"), given.get("network", "swin_s")
    out, checkout = Path(given.get("out", "gpu-check.json")), given.get("release", "")
    rows: dict[str, dict[str, Any]] = {}
    report: dict[str, Any] = {"device": device, "network": network, "rows": rows, "not reached": []}
    chosen = given.get("rows", ",".join(ROWS)).split(",")
    print(f"| row | {' | '.join(COLUMNS)} |\n|{'---|' * (1 + len(COLUMNS))}", flush=True)
    with TemporaryDirectory() as scratch:
        request = [network, device, scratch, *([str(Path(checkout).resolve())] if checkout else [])]
        for row in chosen:
            left = limit_s - (time.monotonic() - began)
            if left < LEAST_S:
                report["not reached"].append(row)
                continue
            if row == "release" and not checkout:
                found = {"failed": "no RELEASE=CHECKOUT was given"}
            elif row == "tests":
                found = run_tests(device, min(left, TESTS_S))
            else:
                found = run_row(row, request, left)
            if "has no cuda" in found.get("failed", ""):
                print(found["failed"], file=sys.stderr)
                return 2
            rows[row] = found
            show(row, found, rows)
            out.write_text(json.dumps(report, indent=1) + "\n")
    report["seconds"] = round(time.monotonic() - began, 1)
    out.write_text(json.dumps(report, indent=1) + "\n")
    conclude(report, out)
    needed = [found for row, found in rows.items() if row != "release" or checkout]
    return int(any("failed" in found for found in needed))


def show(row: str, found: dict[str, Any], rows: dict[str, dict[str, Any]]) -> None:
    """Print a row, with a second line for the release."""
    if row == "tests":
        return
    if "failed" not in found:
        found["share of peak"] = share_of_peak(row, found, rows)
    print(line(ROWS[row], found), flush=True)
    if "release" in found:
        print(line("the release", found["release"]), flush=True)


def conclude(report: dict[str, Any], out: Path) -> None:
    """Print what does not fit the columns."""
    rows = report["rows"]
    if "ratio" in rows.get("release", {}):
        print(f"\nThe release needs {rows['release']['ratio']:.3g} times our time for a step.")
    if "tests" in rows:
        print(f"\nTests marked gpu: {' '.join(rows['tests'].values())}.")
    if "machine" in rows.get("tf32", {}):
        print(examined(rows["tf32"]))
    if report["not reached"]:
        print(f"\nNot reached in the time: {', '.join(report['not reached'])}.")
    for found in [found for found in rows.values() if "machine" in found][:1]:
        print(about(report["device"], found))
    if report["device"] == "cpu":
        print("\nOn a CPU, TF32 has no effect, and no figure says anything about a card.")
    print(f"\n{report['seconds']:.0f} s; everything is in {out}.")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
