"""The commands of README in a fresh clone, without an environment, as they are printed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from tests.docs.pages import ROOT, Page, filled

pytestmark = pytest.mark.docs

HIDDEN = ("PYTHONPATH", "VIRTUAL_ENV", "RGBT_CONF", "RGBT_SHARED", "PYTEST_ADDOPTS", "MAKEFLAGS")

# Ours, and what would activate it: of another installation nothing is used but the dependencies.
OURS = re.compile(r"_?rgbt|_+editable|.*\.pth$|pip\b|pip-")


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A clone with the changes of the working tree, whose trainings have four steps."""
    folder = tmp_path / "rgbt"
    subprocess.run(["git", "clone", "--quiet", ROOT, folder], check=True)
    diff = subprocess.run(["git", "diff", "--binary", "HEAD"], cwd=ROOT, capture_output=True)
    if diff.stdout:
        subprocess.run(["git", "apply"], cwd=folder, input=diff.stdout, check=True)
    demo = folder / "conf" / "scale" / "demo.yaml"
    text = demo.read_text()
    text, number = re.subn(r"^  (max_steps|eval_every): .*$", r"  \1: 4", text, flags=re.MULTILINE)
    assert number == 2
    demo.write_text(text)
    return folder


@pytest.fixture
def variables(tmp_path: Path, clone: Path) -> dict[str, str]:
    """A shell without an environment; pip finds the dependencies here, and needs no network."""
    tools, dependencies = tmp_path / "bin", tmp_path / "dependencies"
    for each in (tools, dependencies):
        each.mkdir()
    (tools / "python3").symlink_to(Path(sys._base_executable))  # type: ignore[attr-defined]
    newest = "ls -td runs/*/result.json | head -1"
    (tools / "newest").write_text(f'#!/bin/sh\ndirname "$({newest})"\n')
    (tools / "newest").chmod(0o755)
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if not OURS.match(path.name):
            (dependencies / path.name).symlink_to(path)
    venv.create(clone / ".venv", symlinks=True)  # make adds pip
    (site,) = (clone / ".venv" / "lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(f"{dependencies}\n")
    kept = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    return {
        **kept,
        "PATH": f"{tools}:/usr/bin:/bin",
        "PIP_NO_INDEX": "1",
        "PIP_NO_BUILD_ISOLATION": "false",  # pip's word for no isolation
        "PYTEST_ADDOPTS": "-k test_module_of_every_command_exists",  # the suite is collected whole
    }


@pytest.mark.slow
def test_readme_in_a_fresh_clone(clone: Path, variables: dict[str, str]) -> None:
    """Both make commands, the installation and the quickstart, one block after the other."""
    page = Page.read(ROOT / "README.md")
    tasks = next(line for line, text in page.prose.items() if text == "## Three tasks")
    blocks = [each for each in page.blocks if each.language == "bash" and each.line < tasks]
    script = "\n".join(["set -e", *(filled(block.text) for block in blocks)])
    assert {"make demo", "make test", "rgbt run +experiment=grbm"} <= set(script.splitlines())
    done = subprocess.run(
        ["bash", "-c", script], cwd=clone, env=variables, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    assert re.search(r"^predict +\.venv/bin/rgbt predict run=", done.stdout, re.MULTILINE)
    assert re.search(r"^1 passed", done.stdout, re.MULTILINE)
    assert re.search(r"^predict +rgbt predict run=", done.stdout, re.MULTILINE), "now it is active"
    assert len(list((clone / "predicted").glob("*_overlay.png"))) == 100
