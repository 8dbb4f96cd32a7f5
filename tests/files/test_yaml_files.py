"""YAML of others is read as plain data, and as OmegaConf reads it."""

from __future__ import annotations

import os
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
        *(("a: {<<: *b}", "undefined alias"), ("a: " + "9" * 5000, "digits")),
        ("a: !!python/object/apply:os.system [touch x]", "the tag 'tag:yaml.org,2002:python"),
        *(
            ("a: !!binary eA==", "the tag"),
            ("a: !!set {b}", "the tag"),
            ("a: !b c", "the tag '!b'"),
        ),
        *(("a: 1\nb: 2\na: 3", "duplicate key 'a'"), ("{1: 2, 0x1: 3}", "duplicate key")),
        *(("? [1]\n: 2", "unhashable key"), ("a: [", "line 2"), ("a: \x00", "control characters")),
        ("--- a\n--- b", "but found another document"),
    ],
    ids=range(12),
)
def test_what_is_no_plain_data_is_refused(text: str, reason: str) -> None:
    with pytest.raises(InputError, match=r"^some\.yaml") as refused:
        parse_yaml(text, "some.yaml")
    assert reason in str(refused.value)
    assert len(str(refused.value)) < 300


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe9")
    for name in ("fifo.yaml", "missing.yaml", "latin.yaml"):
        with pytest.raises(InputError, match=name):
            read_yaml(tmp_path / name)
