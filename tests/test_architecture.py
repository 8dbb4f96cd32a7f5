"""Rules of this repository that a tool can check: imports, global randomness."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = [
    path.relative_to(ROOT)
    for package in ("rgbt", "sweeps", "analysis", "hydra_plugins")
    for path in sorted((ROOT / package).rglob("*.py"))
    if "conf" not in path.parts
]

ALONE = {
    *(
        "types",
        "checks",
        "ranges",
        "randomness",
        "processes",
        "cores",
        "class_scores",
        "averaging",
        "fusion",
    )
}
BASE = ALONE | {"dataset", "requirements", "files", "terminal", "tables"}
SHARED = BASE | {"geometry"}
COMPONENTS = {
    "data",
    "synth",
    "corruptions",
    "transforms",
    "maskers",
    "models",
    "losses",
    "metrics",
}
READING = SHARED | {"config", "runs", "tracking", "metrics", "data"}
BUILDING = READING | COMPONENTS | {"schemes", "engine", "checkpoints", "runtime", "exported"}
RGBT: dict[str, set[str]] = {
    **dict.fromkeys(ALONE, set()),
    "dataset": {"types", "requirements"},
    "requirements": {"types", "checks"},
    "fusion": {"checks"},
    "tables": {"checks", "metrics"},
    "terminal": {"checks", "tables"},
    **dict.fromkeys(("files", "runtime", "geometry"), BASE),
    **dict.fromkeys((*COMPONENTS, "checkpoints", "exported"), SHARED),
    "schemes": SHARED | {"losses"},
    "synth": SHARED | {"data"},  # its files are read by the readers of their layouts
    "engine": SHARED | {"checkpoints", "runtime"},
    "config": BASE | {"runtime"},
    "runs": SHARED | {"config", "metrics", "data", "engine.settings", "engine.prediction"},
    "tracking": SHARED | {"metrics", "runs"},
    "assembly": BUILDING,
    "evaluation": BUILDING | {"assembly"},
    "training": BUILDING | {"assembly", "evaluation"},
}
"""Room of rgbt -> what of rgbt it may import beside itself; commands may import everything."""

COMMAND = {"config", "data"}
"""What a module of a room that is a command itself may import too."""

ROOMS = {
    "sweeps.space": set(),
    "sweeps.plan": {"sweeps.space"},
    "sweeps.run": {f"sweeps.{room}" for room in ("space", "plan")},
    "sweeps.score": {f"sweeps.{room}" for room in ("plan", "run")},
    "sweeps.judge": {f"sweeps.{room}" for room in ("plan", "run", "score")},
    "sweeps.show": {f"sweeps.{room}" for room in ("plan", "run", "score", "judge")},
    "analysis.predictions": set(),
    "analysis.uncertainty": set(),
    "analysis.statistics": {"analysis.uncertainty"},
    "analysis.figures": {f"analysis.{e}" for e in ("statistics", "predictions", "uncertainty")},
}
"""Room of sweeps and analysis -> which others of its package it knows. Their commands join them."""

OUTSIDE = {
    "rgbt": set(),
    "sweeps": {
        "analysis",
        "rgbt.runtime.group",
        "rgbt.runtime.signals",
    }
    | {f"rgbt.{each}" for each in READING - {"data", "geometry"}},
    "analysis": {f"rgbt.{each}" for each in READING - {"geometry"}},
    "hydra_plugins": {"rgbt", "sweeps"},
}
"""Package or room -> what it may import of the other packages, in the order rgbt <- analysis <-
sweeps; the analysis sees no network."""


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse((ROOT / path).read_text())


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def lies_in(name: str, rooms: set[str] | dict[str, set[str]]) -> bool:
    return any(name == each or name.startswith(f"{each}.") for each in rooms)


def forbidden_imports(path: Path) -> Iterator[str]:
    """Modules of this project that the room of `path` may not import."""
    package, *inside = path.with_suffix("").parts
    room = f"{package}.{inside[0]}"
    is_command = path.name == "__main__.py"
    outside = OUTSIDE.get(room, OUTSIDE[package])
    for name in imported(path):
        first, *rest = name.split(".")
        if first not in (*OUTSIDE, "tests") or name == "rgbt":  # for its version
            continue
        if first != package:
            is_allowed = lies_in(name, outside)
        elif package == "rgbt":
            own = RGBT.get(inside[0])
            is_allowed = own is None or is_command or lies_in(".".join(rest), own | {inside[0]})
            if not is_allowed and 'if __name__ == "__main__"' in (ROOT / path).read_text():
                is_allowed = lies_in(".".join(rest), COMMAND)
        else:
            known = ROOMS.get(room)
            is_allowed = known is None or is_command or not lies_in(name, ROOMS)
            is_allowed = is_allowed or lies_in(name, known | {room})
            command = ROOT / package / f"{rest[0]}.py"
            if package == "sweeps" and room in ROOMS and command.is_file():
                is_allowed = 'if __name__ == "__main__"' not in command.read_text()
        if not is_allowed:
            yield f"imports {name}"


TORCH_DRAWS = {"rand", "randn", "randint", "randperm", "bernoulli", "multinomial", "normal"}
DRAWS_IN_PLACE = {"uniform_", "normal_", "bernoulli_", "random_", "exponential_"}
NUMPY_GENERATORS = {"default_rng", "Generator", "PCG64", "SeedSequence"}


def global_draws(path: Path) -> Iterator[str]:
    """Calls that draw from a global generator. Weights are exempt: see `assembly.session`."""
    if "random" in imported(path):
        yield "imports random; use rgbt.randomness"
    for node in ast.walk(tree_of(path)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        name, value = node.func.attr, node.func.value
        is_random = isinstance(value, ast.Attribute) and value.attr == "random"
        if not is_random and name not in TORCH_DRAWS | DRAWS_IN_PLACE:
            continue  # writing the owner of every call as text takes seconds
        owner = ast.unparse(value)
        has_generator = "generator" in {keyword.arg for keyword in node.keywords}
        is_numpy = owner in ("np.random", "numpy.random") and name not in NUMPY_GENERATORS
        is_torch = owner == "torch" and name in TORCH_DRAWS
        is_torch |= name in DRAWS_IN_PLACE and owner != "nn.init"
        if is_numpy or (is_torch and not has_generator):
            yield f"draws from {owner}.{name}"


BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Try)
SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)


def nesting(node: ast.AST, level: int = 0) -> int:
    """Deepest block of a function; `elif` does not deepen, inner functions count alone."""
    worst = level
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, SCOPES):
            is_elif = isinstance(node, ast.If) and isinstance(child, ast.If)
            is_elif = is_elif and child in node.orelse
            worst = max(worst, nesting(child, level + (isinstance(child, BLOCKS) and not is_elif)))
    return worst


def deep_functions(path: Path) -> Iterator[str]:
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and nesting(node) > 3:
            yield f"{node.name} nests {nesting(node)} deep"


@pytest.mark.parametrize("broken", [forbidden_imports, global_draws, deep_functions])
def test_every_file_keeps_the_rule(broken: Callable[[Path], Iterator[str]]) -> None:
    assert [f"{path} {what}" for path in FILES for what in broken(path)] == []


def module_of(path: Path) -> str:
    return ".".join(path.with_suffix("").parts)


def arrows() -> dict[str, set[str]]:
    """Module -> modules it imports: at the top, in functions, and for types alone."""
    modules = {module_of(path) for path in FILES if path.name != "__init__.py"}
    found: dict[str, set[str]] = {}
    for path in FILES:
        names = {name for full in imported(path) for name in (full, full.rpartition(".")[0])}
        found[module_of(path)] = (names & modules) - {module_of(path)}
    return found


def circle_in(imports: dict[str, set[str]]) -> list[str]:
    """One circle of imports, its first module named again at its end; [] where there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_file_imports_itself_by_way_of_others() -> None:
    assert circle_in(arrows()) == []


def test_circle_is_found() -> None:
    found = circle_in({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()})
    assert sorted(set(found)) == ["b", "c"]
    assert "rgbt.config.command" in arrows()["rgbt.run"]  # at the top, and in a function
