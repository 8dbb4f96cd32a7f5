"""YAML of others is read as plain data, and as OmegaConf reads it."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from rgbt.files.yaml_files import parse_yaml, read_yaml


def test_values_are_those_of_omegaconf() -> None:
    texts = [path.read_text() for path in sorted((conf_dir() / "model").rglob("*.yaml"))]
    texts.append("a: 1e-3\nb: 1_000\nc: 010\nd: yes\ne: 2001-01-01\nf: .nan\ng: null\nh: '1e3'\n")
    for text in texts:
        expected = OmegaConf.to_container(OmegaConf.create(text))
        assert str(parse_yaml(text, "x")) == str(expected)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        *(("a: {<<: *b}", "undefined alias"), ("a: " + "9" * 5000, "5000 char")),
        ("a: !!python/object/apply:os.system [touch x]", "the tag 'tag:yaml.org,2002:python"),
        *(
            ("a: !!binary eA==", "the tag"),
            ("a: !!set {b}", "the tag"),
            ("a: !b c", "the tag '!b'"),
        ),
        *(("a: 1\nb: 2\na: 3", "duplicate key 'a'"), ("{1: 2, 0x1: 3}", "duplicate key")),
        *(("? [1]\n: 2", "unhashable key"), ("a: [", "line 2"), ("a: \x00", "control characters")),
        ("--- a\n--- b", "but found another document"),
        *(("a: &a 1\nb: *a", "line 1: found an alias"), ("a: &a [*a]", "found an alias")),
        *(("a: {<<: {b: 1}}", "2002:merge"), ("? &a b\n: *a", "found an alias")),
        # In hexadecimal, and to base 60, whose square of the length and overflow take a while.
        *(("a: 0x" + "F" * 5000, "5002 char"), ("a: " + "1:" * 200 + "1.5", "403 char")),
        *(("[" * 51 + "a" + "]" * 51, "levels"), ("[" * 2000, "nesting depth")),
    ],
    ids=range(20),
)
def test_what_is_no_plain_data_is_refused(text: str, reason: str) -> None:
    with pytest.raises(InputError, match=r"^some\.yaml") as refused:
        parse_yaml(text, "some.yaml")
    assert reason in str(refused.value)
    assert len(str(refused.value)) < 300


def test_aliases_of_aliases_are_refused_in_no_time() -> None:
    """Of 9 levels of 9 aliases: 3.5e9 values."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{n}: &a{n} [{', '.join(9 * [f'*a{n - 1}'])}]" for n in range(1, 11)]
    began = time.process_time()
    with pytest.raises(InputError, match="found an alias"):
        parse_yaml("\n".join(lines), "some.yaml")
    assert time.process_time() - began < 1
    assert parse_yaml("[" * 50 + "a" + "]" * 50, "x"), "as deep as may be"
    assert parse_yaml("a: &unused 1", "x") == {"a": 1}


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe9")
    for name in ("fifo.yaml", "missing.yaml", "latin.yaml"):
        with pytest.raises(InputError, match=name):
            read_yaml(tmp_path / name)
