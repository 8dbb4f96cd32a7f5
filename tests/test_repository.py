"""What GitHub and pre-commit run are targets and tools that the Makefile has."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
MAKEFILE = (ROOT / "Makefile").read_text()


def load(name: str) -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((ROOT / name).read_text())
    return loaded


def recipe(target: str) -> list[str]:
    """The first words of the lines of a target."""
    lines = re.search(rf"^{target}:.*\n((?:\t.*\n)+)", MAKEFILE, re.M)
    assert lines is not None, target
    return [line.split()[0] for line in lines[1].splitlines()]


def test_workflow_calls_targets_that_exist() -> None:
    jobs = load(".github/workflows/ci.yml")["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert commands == ["make lint", "make test", ".ci/run"]
    targets = re.findall(r"^make (\S+)$", (ROOT / ".ci/run").read_text(), re.M)
    for target in ("lint", "test", *targets):
        assert recipe(target)


def test_workflow_tests_the_oldest_python_that_is_promised() -> None:
    versions = load(".github/workflows/ci.yml")["jobs"]["test"]["strategy"]["matrix"]["python"]
    promised = re.search(
        r'^requires-python = ">=(.*)"$', (ROOT / "pyproject.toml").read_text(), re.M
    )
    assert promised is not None
    assert versions[0] == promised[1]


def test_pre_commit_runs_the_tools_of_make_lint() -> None:
    hooks = load(".pre-commit-config.yaml")["repos"][0]["hooks"]
    tools = [hook["entry"].split()[0].replace(".venv", "$(VENV)") for hook in hooks]
    assert sorted(tools) == sorted(word.replace("$(BIN)", "$(VENV)/bin") for word in recipe("lint"))
    (spelled,) = (hook["files"] for hook in hooks if hook["id"] == "codespell")
    texts = re.search(r"^TEXTS := (.*)$", MAKEFILE, re.M)
    assert texts is not None
    for name in texts[1].split():
        path = f"{name}/x.py" if (ROOT / name).is_dir() else name
        assert re.match(spelled, path), name
    assert not re.match(spelled, "tests/x.py")
