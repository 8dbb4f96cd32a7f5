"""Record command, code, versions and machine of a result, also outside a git checkout."""

from __future__ import annotations

import hashlib
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

COMMIT_LENGTH = 10

PACKAGE = Path(__file__).resolve().parents[1]
CODE = (".py", ".csv")
"""Files of the package that a result may depend on; the configuration is in the run's key."""

DIFF_LIMIT = 2_000_000
"""Characters of uncommitted changes that are kept; a longer diff ends with a line that says so."""


def provenance() -> dict[str, Any]:
    """The record of how this process makes its results.

    Returns:
        ``started`` (ISO 8601, UTC), ``command`` (as typed, passwords hidden), ``cwd``, ``pid``,
        ``git_commit`` and ``git_dirty`` (None where this code is not under git), ``untracked``
        (files the diff does not show), ``diff`` (text), ``code`` (`package_digest`), ``python``,
        ``packages`` (name -> version), and the machine: ``threads`` (of torch on the CPU),
        ``host``, ``platform``, ``cpu``, ``cpu_count``, ``cpu_usable``, ``memory_gib``, ``gpus``
        (names), ``cuda``.
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
    """Git commit of a process, "+" after it for uncommitted changes; "" where there is none."""
    commit = process.get("git_commit")
    return f"{commit[:COMMIT_LENGTH]}{'+' if process.get('git_dirty') else ''}" if commit else ""


@cache
def code() -> dict[str, Any]:
    """The code of this package as this process first saw it: the part of `provenance` on it."""
    return {**_code(Path(__file__).resolve()), "code": package_digest(PACKAGE)}


def package_digest(package: Path) -> str:
    """SHA-256 in hexadecimal over the names and contents of a package's code and tables."""
    digest = hashlib.sha256()
    for path in sorted(found for suffix in CODE for found in package.rglob(f"*{suffix}")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(package)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


HIDDEN = "***"

ADDRESS = r"(?<![\w+.-])((?:[\w+.-]+)?://"
"""The scheme of an address; a match begins with it and not inside it."""

LONGEST = 2000
"""Characters of a password; a limit, so that no text takes minutes."""

KEYS = (
    r"(?<![\w.-])(?:[\w.-]*(?:password|passwd)|token|"
    r"(?:\w*_)?(?:(?:api|access)_?key|secret|(?:access|auth|session|tracking)_?token))"
)
"""Names of credentials. A setting such as mask_token or num_tokens is none of them."""

SECRETS = (
    # scheme://user:password@host. The password reaches to the last @, and may hold "/", as for
    # SQLAlchemy. For http, digits and "/" after the colon are a port and a path.
    (
        rf"(?!https?://[^/\s:@'\"]*:\d+[/?#]){ADDRESS}[^/\s:@'\"]*):[^\s'\"]{{1,{LONGEST}}}@",
        rf"\1:{HIDDEN}@",
    ),
    # The same inside an address, percent-encoded.
    (
        rf"(%3A%2F%2F(?:(?!%3A|%40|%2F)[^\s&'\"])*%3A)[^\s&'\"]{{1,{LONGEST}}}%40",
        rf"\1{HIDDEN}%40",
    ),
    # scheme://token@host; before a database, and in ssh://git@host, it is the name of a user.
    (
        rf"(?!(?:postgres|mysql|mariadb|mssql|oracle|(?:git\+)?ssh)[\w+.-]*://)"
        rf"{ADDRESS})[^/\s:@'\"]+@",
        rf"\1{HIDDEN}@",
    ),
    # password=..., sslpassword='...', MLFLOW_TRACKING_TOKEN=..., in addresses, libpq's key=value
    # texts and commands.
    (
        rf"({KEYS}(?:\s*=\s*|%3D))"
        r"(?:'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"|[^\s&'\"]+)",
        rf"\1{HIDDEN}",
    ),
)


def without_passwords(text: str) -> str:
    """`text` with credentials replaced by ``***``, so that it may be stored and shown.

    Hidden are ``user:password@`` and ``token@`` of addresses, and the values of keys such as
    ``password=`` and ``token=``. Applied twice it gives the same.
    """
    for pattern, replacement in SECRETS:
        text = re.sub(pattern, replacement, text, flags=re.IGNORECASE)
    return text


def command_line(words: Sequence[str]) -> str:
    """A command as one types it, without passwords: quotes of the shell do not end one."""
    return shlex.join(map(without_passwords, words))


def _code(file: Path) -> dict[str, Any]:
    """Commit and uncommitted changes of the checkout that tracks `file`."""
    unknown: dict[str, Any] = {"git_commit": None, "git_dirty": None, "untracked": [], "diff": ""}
    # An installed copy may lie inside some other project's checkout: that commit would mislead.
    if _git(file.parent, "ls-files", "--error-unmatch", file.name) is None:
        return unknown
    root = Path((_git(file.parent, "rev-parse", "--show-toplevel") or "").strip())
    commit = _git(root, "rev-parse", "HEAD")
    if commit is None:
        return unknown
    diff = _git(root, "diff", "HEAD") or ""
    untracked = (_git(root, "ls-files", "--others", "--exclude-standard") or "").splitlines()
    if len(diff) > DIFF_LIMIT:
        diff = f"{diff[:DIFF_LIMIT]}\n(cut after {DIFF_LIMIT} characters)\n"
    return {
        "git_commit": commit.strip(),
        "git_dirty": bool(diff or untracked),
        "untracked": untracked,
        "diff": diff,
    }


def _git(folder: Path, *arguments: str) -> str | None:
    """Output of a git command, or None where git is missing or refuses."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=20,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout


@cache
def packages() -> dict[str, str]:
    """Name -> version of the installed distributions as this process first saw them."""
    found = dict(map(_name_and_version, metadata.distributions()))
    return {name: found[name] for name in sorted(found, key=str.lower)}


def _name_and_version(distribution: metadata.Distribution) -> tuple[str, str]:
    """Both from the first lines of the metadata: parsing all of them takes ten times as long."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    fields = dict(line.partition(": ")[::2] for line in text.split("\n\n", 1)[0].splitlines())
    if "Name" in fields and "Version" in fields:
        return fields["Name"].strip(), fields["Version"].strip()
    return distribution.metadata["Name"], distribution.version


def machine() -> dict[str, Any]:
    """The machine: processor, cores, memory, graphics cards, threads of torch."""
    # Imported here, so that reading provenance does not cost the start of torch.
    import torch

    gpus = range(torch.cuda.device_count()) if torch.cuda.is_available() else ()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    model = [line.partition(":")[2] for line in lines if line.startswith("model name")]
    return {
        "threads": torch.get_num_threads(),
        "host": platform.node(),
        "platform": platform.platform(),
        "cpu": model[0].strip() if model else platform.processor() or platform.machine(),
        "cpu_count": os.cpu_count(),
        "cpu_usable": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "memory_gib": round(memory / 2**30, 1),
        "gpus": [torch.cuda.get_device_name(index) for index in gpus],
        "cuda": torch.version.cuda,
    }
