"""The code of a checkout is part of the run key, its path is not."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.spec.checkout_code import checkout_code
from rgbt.spec.specify import specify
from tests.models.external.standins import STACKED, write_checkout

FILES = {
    "code/model/__init__.py": "import model.util\n",
    "code/model/net.py": f"from .util import VALUE\nimport torch, other\n{STACKED}",
    "code/model/util.py": "def lazily():\n    from model.deep import part\n",
    "code/model/deep/part.py": "VALUE = 1\n",
    "code/train.py": "print('not imported')\n",
    "other.py": "outside of the root\n",
}
WORDS = ("model=external", "model.root=code", "model.constructor=model.net:Net")


def key(folder: Path, *words: str) -> str:
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
    empty = specify(compose([*WORDS, f"model.checkout={tmp_path}", "model.empty_packages=[model]"]))
    assert "checkout/model" not in empty.own_code()


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
    before = key(write_checkout(tmp_path, FILES))
    (tmp_path / file).write_text(text)
    assert (key(tmp_path) != before) == counts


def test_key_does_not_depend_on_where_the_checkout_lies(tmp_path: Path) -> None:
    first = write_checkout(tmp_path / "a", FILES)
    shutil.copytree(first, tmp_path / "b")
    assert key(first) == key(tmp_path / "b")
    assert key(first) != key(first, "model.multiple=32")


def test_key_needs_the_checkout(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"model\.checkout=.*expected a folder that has the mod"):
        key(tmp_path)
