"""Components from outside this repository: a view, and mistakes in the parts of the tutorials."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rgbt import predict
from rgbt.randomness import numpy_generator
from rgbt.run import main
from tests.commands import Call, assert_one_sentence, only_run
from tests.docs.pages import ROOT, Page, write

SMOKE = ("+debug=smoke", "tracking=none", "trainer.accelerator=cpu", "trainer.threads=1")


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Writes the files of a page to an empty folder, which is searched for them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("RGBT_CONF", str(tmp_path / "conf"))

    def written(name: str) -> Path:
        for block in Page.read(ROOT / "docs" / name).blocks:
            if block.title:
                write(block, tmp_path)
        return tmp_path

    return written


def test_data_set_without_new_images_is_reported(lab: Callable[[str], Path], call: Call) -> None:
    folder = lab("how-to/add-other-components.md")
    rng = numpy_generator(0, "arrays")
    for path in (folder / "arrays" / s / n for s in ("train", "val", "test") for n in "ab"):
        path.parent.mkdir(parents=True, exist_ok=True)
        rgb, thermal = (rng.integers(0, 256, (40, 64, *c), np.uint8) for c in ((3,), ()))
        np.savez(path, rgb=rgb, thermal=thermal, label=thermal // 128)
    code, _, err = call(main, "+experiment=mfnet", "dataset=arrays", *SMOKE)
    assert code == 0, err
    words = (f"run={only_run(folder / 'runs')}", "out=out", "trust=my_lab")
    code, _, err = call(predict.entry, *words, f"input={folder}")
    assert code == 2
    assert_one_sentence(err, "Arrays")
