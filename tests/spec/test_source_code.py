"""What of a user's own code counts into the key of a run, and what does not."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rgbt.config.compose import compose
from rgbt.spec import source_code
from rgbt.spec.source_code import counted_modules, user_code
from rgbt.spec.specify import specify

Write = Callable[..., None]
LOSS = """from . import helper
from .deep.parts import part


def loss(x):
    return helper.f(x)
"""
TREE = {
    "my_lab/__init__.py": "",
    "my_lab/losses.py": LOSS,
    "my_lab/helper.py": "import json\nimport numpy as np\n\n\ndef f(x):\n    return np.abs(x)\n",
    "my_lab/deep/parts.py": "def part():\n    import my_tools\n    return my_tools.two\n",
    "my_lab/unrelated.py": "x = 1\n",
    "my_tools.py": "two = 2\n",
}
TARGET = "my_lab.losses.loss"


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Write]:
    """Puts a tree of files on the path, as a process sees it that starts now."""

    def put(changed: dict[str, str] | None = None, folder: str = "here") -> None:
        for name, text in {**TREE, **(changed or {})}.items():
            (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / folder / name).write_text(text)
        forget()
        monkeypatch.syspath_prepend(str(tmp_path / folder))

    def forget() -> None:
        source_code._used_by.clear()
        for name in [name for name in sys.modules if name.startswith("my_")]:
            del sys.modules[name]

    yield put
    forget()


def test_user_code_follows_imports_in_the_users_tree_alone(write: Write) -> None:
    write()
    before = set(sys.modules)
    names = [name for name, _ in user_code([TARGET, "rgbt.losses.dice.Dice", "torch.nn.Linear"])]
    assert names == [
        *("my_lab", "my_lab.deep.parts", "my_lab.helper", "my_lab.losses", "my_tools"),
    ]
    assert not {name for name in set(sys.modules) - before if name.startswith("my_")}


@pytest.mark.parametrize(
    ("file", "text", "counts"),
    [
        ("my_lab/losses.py", LOSS.replace("helper.f(x)", "2 * helper.f(x)"), True),
        ("my_lab/deep/parts.py", "def part():\n    import my_tools\n    return 3\n", True),
        ("my_tools.py", "two = 2.0\n", True),
        ("my_lab/__init__.py", "import warnings\n", True),
        ("my_tools.py", '"""Of mine."""\n\n# the number\ntwo = (\n    2\n)\n', False),
        ("my_lab/unrelated.py", "x = 2\n", False),
    ],
)
def test_user_code_changes_with_what_runs(write: Write, file: str, text: str, counts: bool) -> None:
    write()
    before = user_code([TARGET])
    write({file: text})
    assert (user_code([TARGET]) != before) == counts


def test_user_code_does_not_depend_on_where_it_lies(write: Write) -> None:
    write()
    before = user_code([TARGET])
    write({}, "elsewhere")
    assert user_code([TARGET]) == before


def test_counted_modules_are_those_that_a_sweep_loads_for_its_runs(write: Write) -> None:
    write()
    user_code(["my_tools.two", TARGET])
    assert counted_modules() == [], "nothing was imported"
    importlib.import_module("my_tools")
    assert counted_modules() == ["my_tools"]


def test_user_code_of_an_installed_distribution_is_its_version() -> None:
    import scipy

    assert user_code(["scipy.optimize.minimize"]) == (("scipy", scipy.__version__),)


def test_user_code_of_released_targets_and_the_standard_library_is_empty() -> None:
    assert user_code(["rgbt.losses.dice.Dice", "torch.optim.AdamW", "builtins.dict"]) == ()


def test_run_key_counts_the_code_of_own_targets_alone(write: Write) -> None:
    config = compose(["+experiment=baseline"])
    released = specify(config).key
    masker = {
        "my_masker.py": "class Mine:\n    def __init__(self, *, cell: int = 4):\n        pass\n"
    }
    write(masker)
    own = config.copy()
    own.masker = {"_target_": "my_masker.Mine"}
    first = specify(own).key
    write({"my_masker.py": masker["my_masker.py"].replace("pass", "self.cell = cell")})
    second = specify(own).key
    write(masker, "elsewhere")
    assert len({released, first, second}) == 3
    assert (specify(own).key, specify(config).key) == (first, released)
    # Trackers are no part of a run, whoever wrote them.
    config.tracking = {"_target_": "my_masker.Mine"}
    assert specify(config).key == released
