"""Named mutants: faults that a test must find. ``python -m tests.mutants [ROOM ...] [jobs=2]``.

``tests/mutants/ROOM.yaml`` lists mutants by name: `file`, the text `old` (once in the file), the
text `new` that replaces it, and `test`, the words given to pytest. Each mutant is written into a
copy of the tree. A mutant dies if a test fails; the same tests must pass without it. The exit code
is 1 if one survives.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

import yaml

ROOT = Path(__file__).resolve().parents[2]
OUTCOMES = {0: "survives", 1: "dies"}
PYTEST = (sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider")

Mutant = Mapping[str, str]


def mutants(rooms: list[str]) -> dict[str, Mutant]:
    """The mutants of the named rooms, of all rooms if none is named, by ``room/name``."""
    files = sorted(Path(__file__).parent.glob("*.yaml"))
    chosen = [file for file in files if file.stem in rooms or not rooms]
    return {
        f"{file.stem}/{name}": mutant
        for file in chosen
        for name, mutant in yaml.safe_load(file.read_text()).items()
    }


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


def run_tests(tree: Path, words: str) -> int:
    """Exit code of pytest on the words of `test`, in a copy of the tree."""
    command = [*PYTEST, *words.split()]
    return subprocess.run(command, cwd=tree, capture_output=True, check=False).returncode


def outcome(tree: Path, mutant: Mutant) -> str:
    """What became of one mutant: dies, survives, or why it cannot be tried."""
    path = tree / mutant["file"]
    text = path.read_text()
    if text.count(mutant["old"]) != 1:
        return f"`old` occurs {text.count(mutant['old'])} times in {mutant['file']}"
    try:
        path.write_text(text.replace(mutant["old"], mutant["new"]))
        code = run_tests(tree, mutant["test"])
    finally:
        path.write_text(text)
    return OUTCOMES.get(code, f"pytest ends with exit code {code}")


def main(arguments: list[str]) -> int:
    """Print one line per mutant; the exit code is 1 if one does not die."""
    options = dict(each.split("=") for each in arguments if "=" in each)
    chosen = mutants([each for each in arguments if "=" not in each])
    jobs = int(options.get("jobs", 2))
    trees: SimpleQueue[Path] = SimpleQueue()

    def tried(name: str) -> str:
        tree = trees.get()
        try:
            found = outcome(tree, chosen[name])
        finally:
            trees.put(tree)
        print(f"{name:60} {found}", flush=True)
        return found

    with tempfile.TemporaryDirectory() as folder:
        for number in range(jobs):
            trees.put(copy_of_tree(Path(folder, str(number))))
        tests = sorted({mutant["test"] for mutant in chosen.values()})
        # All at once, but for those that options select.
        together = " ".join(dict.fromkeys(" ".join(t for t in tests if "-" not in t).split()))
        alone = [each for each in tests if "-" in each]
        with ThreadPoolExecutor(jobs) as pool:
            found = list(pool.map(tried, chosen))
            tree = trees.get()
            is_clean = all(run_tests(tree, each) == 0 for each in filter(None, [together, *alone]))
    survivors = sum(each != "dies" for each in found)
    print(f"{len(found)} mutants, {survivors} do not die; tests without mutants: {is_clean}")
    return int(survivors > 0 or not is_clean)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
