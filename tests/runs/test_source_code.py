"""What of a user's own code counts into the key of a run, and what does not."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.runs import source_code
from rgbt.runs.source_code import checkout_code, counted_modules, user_code
from rgbt.runs.specify import specify
from tests.models.external.standins import STACKED, write_checkout

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
    assert counted_modules() == [], "nothing was imported"
    importlib.import_module("my_tools")
    assert counted_modules() == ["my_tools"], "what a sweep loads for its runs"


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
    write({}, "elsewhere")
    assert user_code([TARGET]) == before


def test_installed_user_code_is_its_version_and_ours_none() -> None:
    import scipy

    assert user_code(["scipy.optimize.minimize"]) == (("scipy", scipy.__version__),)
    assert user_code(["rgbt.losses.dice.Dice", "torch.optim.AdamW", "builtins.dict"]) == ()


def test_run_key_counts_the_code_of_own_targets_alone(write: Write) -> None:
    config = compose(["+experiment=baseline"])
    released = specify(config).key
    masker = "class Mine:\n    def __init__(self, *, cell: int = 4):\n        pass\n"
    write({"my_masker.py": masker})
    own = config.copy()
    own.masker = {"_target_": "my_masker.Mine"}
    first = specify(own).key
    write({"my_masker.py": masker.replace("pass", "self.cell = cell")})
    second = specify(own).key
    assert len({released, first, second}) == 3
    assert specify(config).key == released
    # Trackers are no part of a run, whoever wrote them.
    config.tracking = {"_target_": "my_masker.Mine"}
    assert specify(config).key == released


# The checkout of another author.

FILES = {
    "code/model/__init__.py": "import model.util\n",
    "code/model/net.py": f"from .util import VALUE\nimport torch, other\n{STACKED}",
    "code/model/util.py": "def lazily():\n    from model.deep import part\n",
    "code/model/deep/part.py": "VALUE = 1\n",
    "code/train.py": "print('not imported')\n",
    "other.py": "outside of the root\n",
}
WORDS = ("model=external", "model.root=code", "model.constructor=model.net:Net")


def key_of_checkout(folder: Path, *words: str) -> str:
    return specify(compose([*WORDS, f"model.checkout={folder}", *words])).key


def test_code_covers_what_the_constructor_imports(tmp_path: Path) -> None:
    write_checkout(tmp_path, FILES)
    node = {**compose([*WORDS, f"model.checkout={tmp_path}"]).model, "_target_": "other.Net"}
    assert checkout_code(node) == ()
    spec = specify(compose([*WORDS, f"model.checkout={tmp_path}"]))
    assert list(spec.own_code()) == [
        *("checkout/model", "checkout/model.deep.part", "checkout/model.net"),
        "checkout/model.util",
    ]


@pytest.mark.parametrize(
    ("file", "text", "counts"),
    [
        ("code/model/deep/part.py", "VALUE = 2\n", True),
        ("code/model/deep/part.py", "# a comment\nVALUE = 1\n", False),
        ("code/train.py", "print('changed')\n", False),
        ("other.py", "CHANGED = 1\n", False),
    ],
)
def test_key_changes_with_the_code_that_is_imported(
    tmp_path: Path, file: str, text: str, counts: bool
) -> None:
    before = key_of_checkout(write_checkout(tmp_path, FILES))
    (tmp_path / file).write_text(text)
    assert (key_of_checkout(tmp_path) != before) == counts
    assert key_of_checkout(write_checkout(tmp_path / "elsewhere", FILES)) == before


def test_key_changes_with_an_adapter_and_what_it_imports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RGBT_CONF", str(tmp_path / "conf"))
    text = "def network():\n    from model import net\n    return net.Net(3)\n"
    adapter = tmp_path / "conf" / "model" / "external" / "odd.py"
    write_checkout(adapter.parent, {"odd.py": text})
    folder, named = write_checkout(tmp_path / "x", FILES), ("model.constructor=odd.py:network",)
    first = key_of_checkout(folder, *named)
    (folder / "code/model/deep/part.py").write_text("VALUE = 2\n")
    second = key_of_checkout(folder, *named)
    adapter.write_text(text.replace("3", "4"))
    assert len({first, second, key_of_checkout(folder, *named)}) == 3
    with pytest.raises(InputError, match=r"^model\.checkout="):
        key_of_checkout(tmp_path, *named, "model.root=.")  # has no module that the adapter imports
