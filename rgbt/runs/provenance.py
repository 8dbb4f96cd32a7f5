"""Record command, code, versions and machine of a result; compare its code with the present code.

The key of a run does not hold the code of this package: every change of it would hide all results.
Instead each process records its code, and commands that show a result compare.
"""

from __future__ import annotations

import hashlib
import math
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from rgbt.cores import usable_cores
from rgbt.runs.folder import read_provenance
from rgbt.terminal import info, warn

COMMIT_LENGTH = 10

PACKAGE = Path(__file__).resolve().parents[1]

# Characters of uncommitted changes that are kept; a longer diff ends with a line that says so.
DIFF_LIMIT = 2_000_000

HIDDEN = "***"

SECRETS = (
    # scheme://user:password@host. The password reaches to the last @, and may hold "/", as for
    # SQLAlchemy. For http, digits and "/" after the colon are a port and a path.
    r"((?!https?://[^/\s:@'\"]*:\d+[/?#])(?<![\w+.-])[\w+.-]*://[^/\s:@'\"]*:)[^\s'\"]+(?=@)",
    # https://token@host
    r"((?<![\w+.-])(?:git\+)?https?://)[^/\s:@'\"]+(?=@)",
    # password=..., sslpassword='...', MLFLOW_TRACKING_TOKEN=... in addresses, libpq's texts and
    # commands; mask_token and num_tokens are none.
    r"((?<![\w.-])(?:[\w.-]*(?:password|passwd)|token|(?:\w*_)?(?:(?:api|access)_?key|secret|"
    r"(?:access|auth|session|tracking)_?token))\s*=\s*)"
    r"(?:'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"|[^\s&'\"]+)",
)


def without_passwords(text: str) -> str:
    """Write ``***`` for credentials in `text` (`SECRETS`); applied twice it gives the same."""
    for pattern in SECRETS:
        text = re.sub(pattern, rf"\1{HIDDEN}", text, flags=re.IGNORECASE)
    return text


def command_line(words: Sequence[str]) -> str:
    """Return a command as one types it, without passwords: quotes of the shell do not end one."""
    return shlex.join(map(without_passwords, words))


def provenance() -> dict[str, Any]:
    """Return the record of how this process makes its results: `code`, `packages`, `machine`, and
    ``started`` (ISO 8601, UTC), ``command`` (passwords hidden), ``cwd``, ``pid``, ``python``.
    """
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command_line(sys.orig_argv),
        "cwd": str(Path.cwd()),
        "pid": os.getpid(),
        **code(),
        "python": platform.python_version(),
        "packages": packages(),
        **machine(),
    }


def commit_of(process: Mapping[str, Any]) -> str:
    """Return the commit of a process, with "+" for uncommitted changes; "": there is none."""
    commit = process.get("git_commit")
    return f"{commit[:COMMIT_LENGTH]}{'+' if process.get('git_dirty') else ''}" if commit else ""


@cache
def code() -> dict[str, Any]:
    """Record this package's code as this process first saw it: `checkout_of`, `package_digest`."""
    return {**checkout_of(Path(__file__).resolve()), "code": package_digest(PACKAGE)}


def package_digest(package: Path) -> str:
    """Return the SHA-256 of names and contents of a package's code and tables, in hexadecimal."""
    digest = hashlib.sha256()
    for path in sorted(file for file in package.rglob("*") if file.suffix in (".py", ".csv")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(package)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def checkout_of(file: Path) -> dict[str, Any]:
    """Read commit (None: not under git) and uncommitted changes of the checkout of `file`."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(file.parent), *arguments]
        done = subprocess.run(command, capture_output=True, timeout=20, check=True)
        return done.stdout.decode(errors="replace")

    try:
        # An installed copy may lie inside some other project's checkout: that commit would mislead.
        git("ls-files", "--error-unmatch", file.name)
        commit, diff = git("rev-parse", "HEAD").strip(), git("diff", "HEAD")
        others = git("ls-files", "--others", "--exclude-standard", "--full-name", ":/")
    except (OSError, subprocess.SubprocessError):  # git is missing or refuses
        return {"git_commit": None, "git_dirty": None, "untracked": [], "diff": ""}
    untracked = others.splitlines()
    is_dirty = bool(diff or untracked)
    if len(diff) > DIFF_LIMIT:
        diff = f"{diff[:DIFF_LIMIT]}\n(cut after {DIFF_LIMIT} characters)\n"
    return {"git_commit": commit, "git_dirty": is_dirty, "untracked": untracked, "diff": diff}


@cache
def packages() -> dict[str, str]:
    """Name -> version of the installed distributions as this process first saw them."""
    found = {}
    for distribution in metadata.distributions():
        # The first lines of the metadata: parsing all of them takes ten times as long.
        text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
        fields = dict(line.partition(": ")[::2] for line in text.split("\n\n", 1)[0].splitlines())
        found[fields.get("Name", "").strip()] = fields.get("Version", "").strip()
    return {name: found[name] for name in sorted(found, key=str.lower) if name}


def machine() -> dict[str, Any]:
    """Return the machine: processor, cores, memory, GPUs; threads and precision of torch."""
    # Imported here, so that reading provenance does not cost the start of torch.
    import torch

    gpus = range(torch.cuda.device_count()) if torch.cuda.is_available() else ()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    cpuinfo = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    model = re.search(r"^model name\s*: *(.+)", cpuinfo, re.MULTILINE)
    return {
        "threads": torch.get_num_threads(),
        "host": platform.node(),
        "platform": platform.platform(),
        "cpu": model[1].strip() if model else platform.processor() or platform.machine(),
        "cpu_count": os.cpu_count(),
        "cpu_usable": usable_cores(),
        "memory_gib": round(memory / 2**30, 1),
        "gpus": [torch.cuda.get_device_name(index) for index in gpus],
        "cuda": torch.version.cuda,
        "matmul_precision": torch.get_float32_matmul_precision(),
    }


def machine_name(entry: Mapping[str, Any]) -> str:
    """Name the graphics card of a `machine` or entry of provenance, else its processor, or ""."""
    return str((entry.get("gpus") or [entry.get("cpu") or ""])[0])


def other_code(folder: Path) -> str | None:
    """Say "commit abc1234567 of 2026-11-20, now def5678901+" where a run has other code.

    Compared is the digest of the package's source, so that changed documents and tests are no
    other code. What a process did after the step at which a later one began does not count.
    """
    now, found, kept_until = code(), None, math.inf
    for entry in reversed(read_provenance(folder / "provenance.json")):
        begin = entry.get("from_step", 0)
        if begin < kept_until and entry.get("code", now["code"]) != now["code"]:
            found = entry
        kept_until = min(kept_until, begin)
    if found is None:
        return None
    was, present = (
        f"commit {commit_of(e)}" if commit_of(e) else "code without a commit" for e in (found, now)
    )
    return f"{was} of {str(found.get('started'))[:10]}, now {present}"


def warn_of_result(folder: Path) -> None:
    """Report that a finished run was made by other code."""
    if made_by := other_code(folder):
        info(
            f"this result was made by other code ({made_by}). fresh=true trains the run again and "
            "keeps the old result."
        )


def warn_of_steps(folder: Path, step: int) -> None:
    """Report that a run that resumes was trained by other code before."""
    if made_by := other_code(folder):
        warn(
            f"the first {step} steps were trained by other code ({made_by}). To train all steps "
            f"with the present code, remove {folder} and rerun the command."
        )
