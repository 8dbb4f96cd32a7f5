"""The figure of corruptions: its numbers by hand, what is drawn, what is refused."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.figures.__main__ import entry
from analysis.figures.robustness import MISSING, Curve, draw, numbers, panels
from analysis.robustness import Training, levels_of
from rgbt.checks import InputError
from tests.analysis.figures.drawn import letters, texts
from tests.analysis.robust_runs import SCORES, less, write_levels, write_run
from tests.commands import Call

Scores = dict[tuple[str, str, str, float], int]


@pytest.fixture
def training(tmp_path: Path) -> object:
    def made(name: str, scores: Scores) -> Training:
        folder = write_levels(tmp_path / name, scores)
        return Training(name, folder, levels_of(folder))

    return made


@pytest.fixture
def methods(training) -> dict[str, list[Training]]:
    without_features = {key: each for key, each in less(20).items() if "features" not in key[0]}
    return {
        "CRM": [training("a", SCORES), training("b", less(10))],
        "RTFNet": [training("c", without_features)],
    }


def test_panels_by_hand(methods) -> None:
    missing, noise = panels(methods, "released")
    assert (missing.title, missing.row) == (MISSING, "")
    assert missing.ticks == ("clean", "RGB removed (zeroed)", "thermal alone (features)")
    assert (noise.row, noise.unit, noise.ticks) == ("noise", "grey levels (std)", ())
    assert noise.severities == (0.0, 8.0, 16.0)
    assert [curve.method for curve in noise.curves] == ["CRM", "RTFNet"]
    crm, rtfnet = noise.curves
    np.testing.assert_allclose(crm.mious, [[80, 60, 40], [70, 50, 30]], atol=1e-3)
    np.testing.assert_allclose(rtfnet.mious, [[60, 40, 20]], atol=1e-3)
    np.testing.assert_allclose(missing.curves[0].mious, [[80, 20, 30], [70, 10, 20]], atol=1e-3)
    np.testing.assert_allclose(missing.curves[1].mious, [[60, 0, np.nan]], atol=1e-3)


def test_mean_deviation_and_share_of_clean() -> None:
    curve = Curve("x", np.array([[80.0, 40.0], [50.0, 10.0]]))
    means, spreads = curve.summary(relative=False)
    # Two values lie (80 - 50) / sqrt(2) apart.
    np.testing.assert_allclose(means, [65, 25])
    np.testing.assert_allclose(spreads, [30 / np.sqrt(2)] * 2)
    # Each training against its own clean score: 50 and 20 percent.
    means, spreads = curve.summary(relative=True)
    np.testing.assert_allclose(means, [100, 35])
    np.testing.assert_allclose(spreads, [0, 30 / np.sqrt(2)])
    assert np.isnan(Curve("x", np.array([[80.0, 40.0]])).summary(relative=False)[1]).all()


def test_a_method_that_was_not_measured_keeps_its_colour(training, tmp_path: Path) -> None:
    few = {key: each for key, each in SCORES.items() if key[0] in ("clean", "rgb_removed")}
    methods = {"few": [training("a", few)], "all": [training("b", less(10))]}
    _, noise = panels(methods, "released")
    np.testing.assert_allclose(noise.curves[0].mious, [[80, np.nan, np.nan]], atol=1e-3)
    assert len(numbers([noise])[".csv"].splitlines()) == 1 + 2 + 2
    draw([noise], relative=False)


def test_numbers_as_a_table_and_with_all_digits(methods) -> None:
    found = numbers(panels(methods, "released"))
    assert set(found) == {".md", ".csv"}
    lines = [line for line in found[".md"].splitlines() if line.startswith("| ")]
    assert lines[0] == "| degradation | severity | CRM | RTFNet |"
    assert lines[2] == "| clean | 0 | 75.00 ± 7.07 (100.0 %) | 60.00 (100.0 %) |"
    assert lines[4] == "| thermal alone (features) |  | 25.00 ± 7.07 (33.0 %) |  |"
    assert lines[5].startswith("| noise, RGB and thermal | 8 | 55.00 ± 7.07 (73.2 %) |")
    assert len(lines) == 2 + 5
    rows = list(csv.DictReader(io.StringIO(found[".csv"])))
    assert [(row["degradation"], row["severity"], row["method"]) for row in rows[:3]] == [
        ("clean", "0", "CRM"),
        ("clean", "0", "RTFNet"),
        ("RGB removed (zeroed)", "", "CRM"),
    ]
    assert len(rows) == 9  # five of CRM, four of RTFNet
    # 40 / 80 and 30 / 70 of the clean score.
    (noisy,) = [row for row in rows if (row["severity"], row["method"]) == ("16", "CRM")]
    assert float(noisy["relative"]) == pytest.approx(100 * (40 / 80 + 30 / 70) / 2, abs=1e-2)
    assert (noisy["seeds"], noisy["unit"]) == ("2", "grey levels (std)")
    assert rows[1]["sd"] == ""


@pytest.mark.parametrize("relative", [False, True])
def test_draws_every_panel_with_its_unit_and_methods(
    methods, tmp_path: Path, relative: bool
) -> None:
    figure = draw(panels(methods, "released"), relative=relative)
    found = texts(figure, tmp_path)
    assert {MISSING, "noise, RGB and thermal", "grey levels (std)", "16", "clean"} <= set(found)
    assert {"CRM (2 seeds)", "RTFNet (1 seed)"} <= set(found)
    assert ("% of clean mIoU" in found) == relative
    assert ("mIoU (%)" in found) != relative
    assert min(letters(figure, tmp_path)) >= 7
    curves, _ = figure.axes
    dashed = [line for line in curves.lines if line.get_linestyle() == "--"]
    clean = [100, 100] if relative else [75, 60]
    assert [line.get_ydata()[0] for line in dashed] == pytest.approx(clean, abs=1e-3)
    drawn = [line.get_ydata() for line in curves.lines if line.get_marker() != "None"]
    expected = [[100, 60 / 0.8 / 2 + 50 / 0.7 / 2, 46.43]] if relative else [[75, 55, 35]]
    np.testing.assert_allclose(drawn[0], expected[0], atol=0.01)


def test_incompatible_inputs_are_refused(training, methods) -> None:
    def ladder(*severities: float) -> Scores:
        own = {("noise", "noise", "std", each): 50 for each in severities}
        return {("clean", "clean", "", 0.0): 80, **own}

    short, long = training("s", ladder(8.0)), training("l", ladder(8.0, 16.0))
    for both in ({"x": [short, long]}, {"x": [short], "y": [long]}):
        with pytest.raises(InputError, match=r"noise was measured .*\[8.0\].*\[8.0, 16.0\]"):
            panels(both, "released")
    with pytest.raises(InputError, match="'nois' was not measured; did you mean 'noise'"):
        panels(methods, "released", ["nois"])
    with pytest.raises(InputError, match="only clean images"):
        panels({"x": [training("only", ladder())]}, "released")
    fewer = replace(short.levels[1], counts=short.levels[1].counts.select(["00000D"]))
    cut = replace(short, levels=(short.levels[0], fewer))
    with pytest.raises(InputError, match="a figure shows methods on the same images"):
        panels({"x": [cut]}, "released")


def test_the_command_draws_groups_and_writes_the_numbers(call: Call, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    write_run(runs, "k0", "crm masker=none", 0, SCORES)
    write_run(runs, "k1", "crm masker=none", 1, less(10))
    out = tmp_path / "drawn" / "robustness.svg"
    words = (f"runs_dir={runs}", f"out={out}", "corruptions=noise, rgb_removed")
    code, said, err = call(
        entry, "figure=robustness", "runs=crm masker=none,mine:k0", *words, "absent=exclude"
    )
    assert code == 0, err
    assert said.split() == [str(out.with_suffix(suffix)) for suffix in (".svg", ".md", ".csv")]
    assert "mine (1 seed)" in out.read_text()
    assert "crm masker=none (2 seeds)" in out.read_text()
    assert "thermal alone" not in out.with_suffix(".md").read_text()
