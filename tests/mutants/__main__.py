"""Named mutants: faults that a test must find.

``python -m tests.mutants [ROOM | ROOM/NAME ...] [jobs=2]``

``tests/mutants/ROOM.yaml`` lists mutants by name: `file`, the text `old` (once in the file), the
text `new` that replaces it, and `test`, the words given to pytest. Each mutant is written into a
copy of the tree, and its tests run in a fork of this process, which has imported the libraries.
A mutant dies if a test fails; the same tests must pass without it. The exit code is 1 if one
survives.
"""

from __future__ import annotations

import gc
import importlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = """
    pytest torch torch.utils.checkpoint torch.utils.flop_counter torch.optim.swa_utils numpy cv2
    scipy.optimize scipy.stats PIL.Image pandas matplotlib.figure matplotlib.backends.backend_agg
    hydra hydra.core.plugins hydra.core.override_parser.overrides_parser omegaconf pydantic
    rich.table rich.progress jinja2 markdown_it safetensors.torch lightning_fabric optuna mlflow
    mlflow.store.tracking.sqlalchemy_store sklearn.metrics
"""
PYTEST = ("-x", "-q", "--no-header", "-p", "no:cacheprovider", "--basetemp=../temp")
LIMIT_S = 300
OUTCOMES = {0: "survives", 1: "dies", -signal.SIGALRM: f"does not end in {LIMIT_S} s"}
NO_FAULT = {"file": "pyproject.toml", "old": "[project]\n", "new": "[project]\n"}
TIME_STAMPS = itertools.count(1)

Mutant = Mapping[str, str]


class Ended(NamedTuple):
    """A pytest that has ended: name of the mutant, exit code, seconds of one core, its output."""

    name: str
    code: int
    seconds: float
    output: str


def mutants(words: Iterable[str] = ()) -> dict[str, Mutant]:
    """Mutants by ``room/name``: those of the rooms or of the names in `words`, all if it is empty.

    Raises:
        ValueError: if `old` is not once in the file of a mutant.
    """
    wanted, found, errors = set(words), {}, []
    for file in sorted(Path(__file__).parent.glob("*.yaml")):
        for name, mutant in yaml.safe_load(file.read_text()).items():
            if wanted and not {file.stem, f"{file.stem}/{name}"} & wanted:
                continue
            found[f"{file.stem}/{name}"] = mutant
            path = ROOT / mutant["file"]
            times = path.read_text().count(mutant["old"]) if path.is_file() else 0
            if times != 1:
                errors.append(f"{file.stem}/{name}: `old` is {times} times in {mutant['file']}")
    if errors:
        raise ValueError("\n".join(errors))
    return found


def copy_of_tree(folder: Path) -> Path:
    """The files that git lists, in a folder beside a link to the reference material."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
    tree = folder / "rgbt"
    for name in filter(None, listed.decode().split("\0")):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tree / name)
    if (ROOT.parent / "shared").exists():
        (folder / "shared").symlink_to(ROOT.parent / "shared")
    return tree


def start(tree: Path, words: list[str]) -> int:
    """Fork a pytest with these words in a copy of the tree; returns the number of its process."""
    sys.stdout.flush()
    if number := os.fork():
        return number
    code = 70
    try:
        signal.alarm(LIMIT_S)
        os.chdir(tree)
        output = os.open("../output", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        # Neither this process nor those it starts import a module from the tree that was copied.
        for name in [each for each in sys.modules if each.split(".")[0] == "tests"]:
            del sys.modules[name]
        sys.path[:] = [str(tree), *(each for each in sys.path if Path(each).resolve() != ROOT)]
        os.environ.update(PYTHONPATH=str(tree), PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False
        sys.argv = ["pytest", *PYTEST, *words]
        code = int(importlib.import_module("pytest").main(sys.argv[1:]))
    finally:
        os._exit(code)


def run_all(chosen: Mapping[str, Mutant], trees: list[Path]) -> Iterator[Ended]:
    """Run the tests of every mutant, at any time one pytest in each copy of the tree."""
    running: dict[int, tuple[str, Path, Path, str]] = {}

    def write(path: Path, text: str) -> None:
        path.write_text(text)
        # A time that the file never had: Python takes no bytecode of another text for this one's.
        os.utime(path, (stamp := next(TIME_STAMPS), stamp))

    def ended() -> Ended:
        number, status, used = os.wait3(0)
        name, tree, path, text = running.pop(number)
        write(path, text)
        trees.append(tree)
        output = (tree.parent / "output").read_text(errors="replace")
        code = os.waitstatus_to_exitcode(status)
        return Ended(name, code, used.ru_utime + used.ru_stime, output)

    for name, mutant in chosen.items():
        if not trees:
            yield ended()
        tree = trees.pop()
        path = tree / mutant["file"]
        text = path.read_text()
        write(path, text.replace(mutant["old"], mutant["new"]))
        running[start(tree, mutant["test"].split())] = (name, tree, path, text)
    while running:
        yield ended()


def main(words: list[str]) -> int:
    """Print one line per mutant; the exit code is 1 if one does not die."""
    options = dict(each.split("=") for each in words if "=" in each)
    began = time.monotonic()
    chosen = mutants(each for each in words if "=" not in each)
    chosen = dict(sorted(chosen.items(), key=lambda each: each[1]["test"]))
    # Each test once, those of a room together, but for those that options select.
    clean: dict[str, dict[str, None]] = {}
    for name, mutant in chosen.items():
        test = mutant["test"]
        group = clean.setdefault(test if "-" in test else name.split("/")[0], {})
        group.update(dict.fromkeys([test] if "-" in test else test.split()))
    os.environ["OMP_NUM_THREADS"] = "1"  # a process with threads cannot be forked safely
    for library in LIBRARIES.split():
        importlib.import_module(library)
    gc.freeze()
    with tempfile.TemporaryDirectory() as folder:
        trees = [copy_of_tree(Path(folder, str(n))) for n in range(int(options.get("jobs", 2)))]
        tests = {name: {**NO_FAULT, "test": " ".join(group)} for name, group in clean.items()}
        failed = [each for each in run_all(tests, trees) if each.code]
        for each in failed:
            print(f"{each.output[-3000:]}\n{each.name} fails without a mutant", flush=True)
        found = []
        for each in run_all(chosen, trees):
            found.append(each)
            outcome = OUTCOMES.get(each.code, f"pytest ends with exit code {each.code}")
            count = f"{len(found)}/{len(chosen)}"
            print(f"{count:9}{each.name:70} {outcome} {each.seconds:5.1f} s", flush=True)
    dearest = sorted(found, key=lambda each: -each.seconds)[:10]
    print("dearest:", *(f"{each.seconds:6.1f} s {each.name}" for each in dearest), sep="\n")
    survivors = [each.name for each in found if each.code != 1]
    print("not dead:", *(survivors or ["none"]), sep="\n")
    print(f"{len(found)} mutants in {time.monotonic() - began:.0f} s; clean: {not failed}")
    return int(bool(survivors or failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
