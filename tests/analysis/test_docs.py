"""The worked examples of docs/analysis.md run, one after the other, and print what they promise."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs" / "analysis.md"


def examples() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", DOCS.read_text(), re.MULTILINE | re.DOTALL)


def test_examples_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shared: dict[str, object] = {}
    printed = []
    for code in examples():
        exec(compile(code, str(DOCS), "exec"), shared)
        printed.append(capsys.readouterr().out)
    statistics, scores, comparison = printed
    assert len(re.findall(r"0\.\d+", statistics.splitlines()[0])) == 9
    assert "does not hold" in statistics or "holds" in statistics
    assert re.search(r"mIoU +\d+\.\d\d +\d+\.\d\d to +\d+\.\d\d", scores)
    # A larger shift is a worse prediction, on every image.
    assert re.search(r"mIoU +-\d+\.\d\d .* p = 0\.00\d", comparison)
    assert re.search(r"the mIoU of theirs is .* points lower than that of mine", comparison)
