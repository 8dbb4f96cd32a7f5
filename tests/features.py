"""What a user can choose, as text: commands and their options, figures, and every file of conf/ and
sweeps/tables with its keys. Compare two states of the project by the text of each:

    python -m tests.features > before.txt
"""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from rgbt.config.plain_command import COMMANDS

ROOT = Path(__file__).parents[1]


def output_of(*words: str) -> str:
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def keys_of(node: Any, path: str = "") -> Iterator[str]:
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from keys_of(value, f"{path}.{key}" if path else str(key))
    else:
        yield f"{path} = {node}"


def lines() -> Iterator[str]:
    yield output_of("rgbt", "--help")
    for name, entry in COMMANDS.items():
        yield f"== rgbt {name}\n{output_of(entry.module, '--help')}"
    yield f"== figures\n{output_of('rgbt', 'figures', 'figure=list')}"
    for folder in ("conf", "sweeps/tables"):
        for path in sorted((ROOT / folder).rglob("*.yaml")):
            yield f"== {path.relative_to(ROOT)}"
            yield from keys_of(yaml.safe_load(path.read_text()))


if __name__ == "__main__":
    for line in lines():
        print(line)
