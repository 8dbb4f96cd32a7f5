"""The worked examples of three how-to pages run, page by page, and print what they promise."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

HOW_TO = Path(__file__).resolve().parents[2] / "docs" / "how-to"
PAGES = ("analyse-a-data-set", "score-predictions", "compare-methods")


def examples(page: str) -> str:
    text = (HOW_TO / f"{page}.md").read_text()
    return "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


def test_examples_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = []
    for page in PAGES:
        exec(compile(examples(page), page, "exec"), {})
        printed.append(capsys.readouterr().out)
    statistics, scores, comparison = printed
    assert len(re.findall(r"0\.\d+", statistics.splitlines()[0])) == 9
    assert "does not hold" in statistics or "holds" in statistics
    assert re.search(r"mIoU +\d+\.\d\d +\d+\.\d\d to +\d+\.\d\d", scores)
    # A larger shift is a worse prediction, on every image.
    assert re.search(r"mIoU +-\d+\.\d\d .* p = 0\.00\d", comparison)
    assert re.search(r"the mIoU of theirs is .* points lower than that of mine", comparison)
