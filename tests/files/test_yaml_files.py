"""YAML of others is read as plain data within a budget, and as OmegaConf reads it."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from rgbt.files import yaml_files
from rgbt.files.yaml_files import parse_yaml, read_yaml

ROOT = Path(__file__).resolve().parents[2]
LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 20)
)


def test_values_are_those_of_omegaconf() -> None:
    texts = [path.read_text() for path in sorted((conf_dir() / "model").rglob("*.yaml"))]
    texts.append("a: 1e-3\nb: 1_000\nc: 010\nd: yes\ne: 2001-01-01\nf: .nan\ng: null\nh: '1e3'\n")
    for text in texts:
        expected = OmegaConf.to_container(OmegaConf.create(text))
        assert str(parse_yaml(text, "x")) == str(expected)


def test_every_file_of_this_project_fits_the_budget_four_times() -> None:
    for path in [*(ROOT / "sweeps").rglob("*.yaml"), *(ROOT / "analysis").rglob("*.yaml")]:
        assert read_yaml(path)
        assert 4 * path.stat().st_size < yaml_files.MOST_BYTES


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (LAUGHS, "line 1: anchors and aliases"),
        ("a: {<<: *b}", "line 1: anchors and aliases"),
        ("[" * 60_000, "levels"),  # crashes the process of PyYAML's C reader
        ("- " * 60_000 + "a", "levels"),
        ("[" + "a," * 300_000 + "]", "values and 50 levels"),
        ("a: " + "x" * 20_000, "a value exceeds the limit of 10,000 characters"),
        ("a: " + "x" * 2_000_000, "larger than the limit of 1,000,000 bytes"),
        ("a: !!python/object/apply:os.system [touch x]", "the tag 'tag:yaml.org,2002:python"),
        ("a: " + "9" * 5000, "digits"),
        ("a: 0x" + "f" * 100, "an integer of more than 64 bits"),
        ("a: 1\nb: 2\na: 3", "duplicate key 'a'"),
        ("{1: 2, 0x1: 3}", "duplicate key"),
        ("? [1]\n: 2", "unhashable key"),
        ("a: [", "line 2"),
        ("a: \x00", "control characters"),
        ("--- a\n--- b", "but found another document"),
    ],
    ids=range(16),
)
def test_what_exceeds_the_budget_is_refused_fast(text: str, reason: str) -> None:
    begin, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"^some\.yaml") as refused:
        parse_yaml(text, "some.yaml")
    assert reason in str(refused.value)
    assert len(str(refused.value)) < 300
    assert time.process_time() - begin < 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "fifo.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"a: \xe9")
    for name in ("fifo.yaml", "missing.yaml", "latin.yaml"):
        with pytest.raises(InputError, match=name):
            read_yaml(tmp_path / name)
