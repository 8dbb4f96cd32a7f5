"""Rules of this repository that a tool can check: imports, sizes, nesting, global randomness."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
RGBT = sorted(path for path in (ROOT / "rgbt").rglob("*.py") if "conf" not in path.parts)
SWEEPS = sorted((ROOT / "sweeps").rglob("*.py"))
ANALYSIS = sorted((ROOT / "analysis").rglob("*.py"))
FILES = [*RGBT, *SWEEPS, *ANALYSIS, *sorted((ROOT / "hydra_plugins").rglob("*.py"))]

BASE = {"types", "dataset", "requirements", "checks", "ranges", "randomness", "files", "processes"}
BASE |= {"class_scores"}
SHARED = BASE | {"geometry"}
COMPONENTS = {"data", "corruptions", "transforms", "maskers", "models", "losses", "metrics"}
READING = SHARED | {"config", "spec", "tracking", "metrics", "data"}
BUILDING = READING | COMPONENTS | {"schemes", "engine", "checkpoints", "runtime", "build"}
BUILDING |= {"exported"}
MAY_IMPORT = {
    **dict.fromkeys(
        ("types", "checks", "ranges", "randomness", "processes", "class_scores"), set()
    ),
    "dataset": {"types", "requirements"},
    "requirements": {"types", "checks"},
    "files": BASE,
    "runtime": BASE,
    "geometry": BASE,
    **dict.fromkeys(COMPONENTS, SHARED),
    "schemes": SHARED | {"losses"},
    "checkpoints": SHARED,
    "engine": SHARED | {"checkpoints", "runtime"},
    "exported": SHARED,
    "tracking": SHARED | {"metrics"},
    "config": BASE | {"runtime"},
    "spec": READING | {"engine"},
    "build": BUILDING,
    "evaluation": BUILDING,
    "training": BUILDING | {"evaluation"},
}
"""Folder or module of rgbt -> what of rgbt it may import beside itself. Entry points are the other
modules at the top and every `__main__`, and may import everything."""

COMMAND = {"config", "data"}
"""What a module with a command line (`if __name__ == "__main__"`) may import too."""


@cache
def tree_of(path: Path) -> ast.Module:
    """Parsed once for all tests of a file."""
    return ast.parse(path.read_text())


def imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_command(text: str) -> bool:
    return 'if __name__ == "__main__"' in text


SWEEPS_MAY = BASE | {"config", "spec", "metrics", "tracking"}
"""What of rgbt the sweeps may import: they call its commands and read what these leave. Of the
analysis they may import `analysis.uncertainty` alone, which decides claims."""

ROOMS = {
    "worker": {"space"},
    "space": set(),
    "report": set(),
    "table": {"worker"},
    "verdicts": {"table", "worker"},
    "rendering": {"table", "worker", "report", "verdicts"},
}
"""Folders of sweeps, and which others each of them knows."""


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: str(path.relative_to(ROOT)))
def test_sweeps_imports_only_allowed_modules(path: Path) -> None:
    inside = path.relative_to(ROOT / "sweeps")
    room = inside.parts[0] if len(inside.parts) > 1 else None
    for name in imports(tree_of(path)):
        package, *rest = name.split(".")
        assert package != "tests", f"{inside} imports {name}"
        assert package != "analysis" or rest[:1] == ["uncertainty"], f"{inside} imports {name}"
        if package == "rgbt" and rest:
            assert rest[0] in SWEEPS_MAY, f"{inside} imports {name}"
        if package == "sweeps" and room and rest and rest[0] in ROOMS and rest[0] != room:
            assert rest[0] in ROOMS[room], f"{inside} imports {name}"


ANALYSIS_MAY = BASE | {"config", "spec", "metrics", "tracking", "data"}
"""What of rgbt the analysis may import: data sets and what runs have left, never a network."""

ANALYSIS_ROOMS = {
    "statistics": set(),
    "predictions": set(),
    "uncertainty": set(),
    "figures": {"statistics", "predictions", "uncertainty"},
    "report": {"uncertainty", "figures"},
}
"""Folders of analysis, and which others each of them knows; its commands join them."""

PUBLISHED = ("sweeps.table", "sweeps.verdicts", "sweeps.evaluation", "sweeps.report.study_data")
"""What of the sweeps the report may import: the papers' tables as data, verdicts on their claims,
and studies read."""

PARENTS = {"sweeps.report"}
"""``from sweeps.report import data`` names this too."""


@pytest.mark.parametrize("path", ANALYSIS, ids=lambda path: str(path.relative_to(ROOT)))
def test_analysis_imports_no_network(path: Path) -> None:
    inside = path.relative_to(ROOT / "analysis")
    is_room = len(inside.parts) > 1 and inside.name != "__main__.py"
    for name in imports(tree_of(path)):
        package, *rest = name.split(".")
        assert package != "tests", f"{inside} imports {name}"
        if package == "rgbt" and rest:
            assert rest[0] in ANALYSIS_MAY, f"{inside} imports {name}"
        # The sweeps import it, for the verdicts of claims.
        assert inside.parts[0] != "uncertainty" or package != "sweeps", f"{inside} imports {name}"
        if package == "sweeps" and rest:
            known = any(name == each or name.startswith(f"{each}.") for each in PUBLISHED)
            assert known or name in PARENTS, f"{inside} imports {name}"
        if package == "analysis" and is_room and rest and rest[0] in ANALYSIS_ROOMS:
            room = inside.parts[0]
            assert rest[0] in ANALYSIS_ROOMS[room] | {room}, f"{inside} imports {name}"


@pytest.mark.parametrize("path", RGBT, ids=lambda path: str(path.relative_to(ROOT)))
def test_rgbt_module_imports_only_what_its_folder_may(path: Path) -> None:
    inside = path.relative_to(ROOT / "rgbt")
    folder = inside.parts[0].removesuffix(".py")
    text = path.read_text()
    is_module = len(inside.parts) == 1 and folder not in MAY_IMPORT
    is_entry_point = is_module or inside.name == "__main__.py"
    allowed = MAY_IMPORT.get(folder, set()) | {folder} | (COMMAND if is_command(text) else set())
    for name in imports(tree_of(path)):
        package, *rest = name.split(".")
        assert package not in ("sweeps", "analysis", "tests"), f"{inside} imports {name}"
        if package == "rgbt" and rest and not is_entry_point:
            assert rest[0] in allowed, f"{inside} imports {name}; it may import {sorted(allowed)}"


BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Try)
SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)


def nesting(node: ast.AST, level: int = 0) -> int:
    """Deepest block of a function; `elif` does not deepen, inner functions count alone."""
    worst = level
    for child in ast.iter_child_nodes(node):
        if isinstance(child, SCOPES):
            continue
        is_elif = isinstance(node, ast.If) and isinstance(child, ast.If) and child in node.orelse
        worst = max(worst, nesting(child, level + (isinstance(child, BLOCKS) and not is_elif)))
    return worst


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_functions_fit_a_reader(path: Path) -> None:
    assert path.read_text().count("\n") <= 400, "a file above 400 lines is two files"
    for function in functions(path):
        body = function.body[1:] if ast.get_docstring(function) else function.body
        if not body:
            continue
        size = (function.end_lineno or 0) - body[0].lineno + 1
        assert size <= 60, f"{function.name}: {size} lines"
        assert nesting(function) <= 3, f"{function.name} nests {nesting(function)} deep"


TORCH_DRAWS = {"rand", "randn", "randint", "randperm", "bernoulli", "multinomial", "normal"}
TORCH_DRAWS_IN_PLACE = {"uniform_", "normal_", "bernoulli_", "random_", "exponential_"}
NUMPY_GENERATORS = {"default_rng", "Generator", "PCG64", "SeedSequence"}


def global_draws(tree: ast.AST) -> Iterator[str]:
    """Calls that would draw from a global generator. Weights are exempt: see `build.session`."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        name, value = node.func.attr, node.func.value
        is_random = isinstance(value, ast.Attribute) and value.attr == "random"
        if not is_random and name not in TORCH_DRAWS | TORCH_DRAWS_IN_PLACE:
            continue  # writing the owner of every call as text takes seconds
        owner = ast.unparse(value)
        given = {keyword.arg for keyword in node.keywords}
        if owner in ("np.random", "numpy.random") and name not in NUMPY_GENERATORS:
            yield f"{owner}.{name}"
        drawn = owner == "torch" and name in TORCH_DRAWS
        in_place = name in TORCH_DRAWS_IN_PLACE and owner != "nn.init"
        if (drawn or in_place) and "generator" not in given:
            yield f"{owner}.{name}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nobody_draws_from_a_global_generator(path: Path) -> None:
    tree = tree_of(path)
    assert list(global_draws(tree)) == []
    assert "random" not in list(imports(tree)), "use rgbt.randomness"
