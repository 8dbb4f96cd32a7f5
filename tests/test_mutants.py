"""The list of mutants fits the code: places and tests of `tests/mutants/*.yaml` exist."""

from __future__ import annotations

import re

from tests.mutants.__main__ import ROOT, mutants


def test_every_fault_has_its_place_and_its_test() -> None:
    found = mutants()  # refuses a text that is not once in its file
    assert len(found) >= 150
    for name, mutant in found.items():
        assert mutant["new"] != mutant["old"], name
        for word in mutant["test"].split():
            path, *names = word.partition("[")[0].split("::")
            if path.startswith("tests/"):
                text = (ROOT / path).read_text()
                missing = [each for each in names if not re.search(rf"(def|class) {each}\b", text)]
                assert not missing, f"{name}: {word}"
