"""Factorial designs in table files: their cells, rows, aliases and messages."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from rgbt.checks import InputError
from rgbt.config.values import check_value
from sweeps.plan.design import Design, DesignFactor, DesignMethod, Part, cell_name
from sweeps.plan.measurement import command_of
from sweeps.plan.request import TableRequest
from sweeps.plan.table import load_table

MEANS = {"low_means": "little", "high_means": "much"}
FACTORS: list[dict[str, Any]] = [
    {"letter": name[0].upper(), "name": name, "low": [low], "high": [high], **MEANS}
    for name, low, high in (
        ("noise", "dataset.rgb_noise=0.0", "dataset.rgb_noise=0.1"),
        ("texture", "dataset.texture_strength=1.0", "dataset.texture_strength=2.0"),
    )
]
DESIGN: dict[str, Any] = {
    "factors": FACTORS,
    "methods": [
        {"name": "baseline", "experiment": "baseline"},
        {"name": "crm", "experiment": "crm", "against": "baseline"},
    ],
    "overrides": ["dataset=synth"],
    "outcomes": ["mIoU"],
    "trained": {"overrides": ["dataset.num_far_objects=3"]},
    "tested": {},
}
FILE: dict[str, Any] = {
    "paper": "my",
    "number": "1",
    "caption": "A design.",
    "data": "synth",
    "columns": [{"name": "mIoU", "metric": "mIoU"}],
}


def write(folder: Path, **changes: Any) -> str:
    path = folder / "design.yaml"
    path.write_text(yaml.safe_dump({**FILE, "design": {**DESIGN, **changes}}))
    return str(path)


def factor(**changes: Any) -> dict[str, Any]:
    return {"factors": [FACTORS[0], {**FACTORS[1], **changes}]}


def test_rows_of_a_design_are_methods_times_cells(tmp_path: Path) -> None:
    table = load_table(write(tmp_path))
    cells = ["N-T-", "N-T+", "N+T-", "N+T+"]
    trained = [f"{method} {cell}" for method in ("baseline", "crm") for cell in cells]
    assert [row.label for row in table.rows] == [*trained, "baseline natural", "crm natural"]
    assert table.rows[6].experiment == "crm"
    assert table.rows[6].overrides == (
        *("dataset=synth", "dataset.num_far_objects=3"),
        *("dataset.rgb_noise=0.1", "dataset.texture_strength=1.0"),
    )
    natural = table.rows[9]
    assert natural.overrides == ("dataset=synth",)
    assert list(natural.tested_in) == cells
    assert natural.tested_in["N-T+"] == ("dataset.rgb_noise=0.0", "dataset.texture_strength=2.0")


def test_combined_overrides_follow_those_of_the_factors(tmp_path: Path) -> None:
    combined = [{"levels": {"N": "high", "T": "low"}, "overrides": ["dataset.rgb_noise=0.5"]}]
    table = load_table(write(tmp_path, combined=combined))
    words = {row.label: row.overrides[2:] for row in table.rows[:4]}
    assert words["baseline N+T-"][-1] == "dataset.rgb_noise=0.5"
    assert "dataset.rgb_noise=0.5" not in words["baseline N+T+"]


def test_rows_tested_in_worlds_request_an_evaluation_of_each(tmp_path: Path) -> None:
    table = load_table(write(tmp_path))
    request = TableRequest("my/design", table, "demo", (0,))
    by_label = {point.label: point for point in request.points()}
    assert by_label["crm N-T- seed=0"].evaluations == ()
    worlds = by_label["crm natural seed=0"].evaluations
    assert worlds == tuple(table.rows[9].tested_in.values())
    assert worlds[1] == ("dataset.rgb_noise=0.0", "dataset.texture_strength=2.0")
    assert command_of(worlds[1]) == ("rgbt.evaluate", *worlds[1])
    assert len(set(worlds)) == 4
    ring = replace(request, table=replace(table, regions="ring9"))
    (point,) = (point for point in ring.points() if point.label == "crm natural seed=0")
    assert point.evaluations[2:] == tuple(("regions=ring9", *words) for words in worlds[1:])


def test_worlds_measure_what_the_columns_ask_for(tmp_path: Path) -> None:
    table = load_table(write(tmp_path))
    without = replace(table.columns[0], name="no_rgb", corruption="removed:rgb")
    table = replace(table, columns=(*table.columns, without))
    request = TableRequest("my/design", table, "demo", (0,))
    (point,) = (point for point in request.points() if point.label == "crm natural seed=0")
    worlds = tuple(table.rows[9].tested_in.values())
    removed = tuple(("corruption=removed:rgb", *words) for words in worlds)
    assert point.evaluations == (*worlds, ("corruption=removed:rgb",), *removed)


def test_pairs_of_frames_are_not_tested_in_worlds(tmp_path: Path) -> None:
    columns = [*FILE["columns"], {"name": "TC", "metric": "TC", "frames": "aligned"}]
    path = tmp_path / "design.yaml"
    path.write_text(yaml.safe_dump({**FILE, "columns": columns, "design": DESIGN}))
    with pytest.raises(InputError, match="'TC': pairs of frames"):
        load_table(str(path))


def design(generators: dict[str, str], letters: str = "OCNS") -> Design:
    factors = tuple(
        DesignFactor(letter=letter, name=letter.lower(), low_means="", high_means="")
        for letter in letters
    )
    part, methods = Part(generators=generators), (DesignMethod(name="m", experiment="crm"),)
    return Design(factors=factors, methods=methods, outcomes=("mIoU",), trained=part)


def test_half_fraction_has_the_product_as_last_level() -> None:
    # S is high where an odd number of O, C and N is high.
    assert [cell_name(cell) for cell in design({"S": "OCN"}).cells("trained")] == [
        *("O-C-N-S-", "O-C-N+S+", "O-C+N-S+", "O-C+N+S-"),
        *("O+C-N-S+", "O+C-N+S-", "O+C+N-S-", "O+C+N+S+"),
    ]


def test_half_fraction_mixes_pairs_of_interactions_alone() -> None:
    # I = OCNS, so OC = NS, ON = CS and CN = OS.
    assert design({"S": "OCN"}).effects("trained") == {
        "o": {"O": 1},
        "c": {"C": 1},
        "n": {"N": 1},
        "s": {"S": 1},
        "o x c + n x s": {"OC": 1, "NS": 1},
        "o x n + c x s": {"ON": 1, "CS": 1},
        "o x s + c x n": {"OS": 1, "CN": 1},
    }


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        (factor(letter="N"), "used twice"),
        (factor(low=[], high=[]), "equal overrides"),
        ({"outcomes": ["mIuO"]}, "outcomes: 'mIuO'"),
        ({"methods": [{"name": "a", "experiment": "crm", "against": "b"}]}, "against .*'b'"),
        ({"methods": [{"name": "a", "experiment": "crn"}]}, "experiment: 'crn'"),
        ({"trained": None, "tested": None}, "trained"),
        ({"trained": {"generators": {"T": "X"}}}, "generators .*'X'"),
        ({"trained": {"generators": {"T": "N"}}}, "N cannot be told apart from T"),
        ({"combined": [{"levels": {"N": "low", "X": "low"}, "overrides": []}]}, "levels: 'X'"),
    ],
)
def test_design_refuses_parts_that_do_not_fit(
    tmp_path: Path, changes: dict[str, Any], key: str
) -> None:
    with pytest.raises(InputError, match=key):
        load_table(write(tmp_path, **changes))


def test_resolution_three_is_refused() -> None:
    with pytest.raises(InputError, match="O cannot be told apart from CN"):
        check_value("design", asdict(design({"N": "OC"}, "OCN")), Design)


def test_study_of_the_spatial_bias_has_its_cells() -> None:
    table = load_table("spatial_bias")
    made = table.design
    assert made is not None
    assert [len(made.cells(part)) for part in ("trained", "tested")] == [8, 16]
    assert len(table.rows) == 5 * 8 + 5
    # Both levels of a radial factor have the same mean square over an image of 3 x 4, where the
    # mean of r^2 is 1/3 and that of r^4 (256/5 + 81/5 + 2 x 144/9) / 625.
    fourth = (256 / 5 + 81 / 5 + 2 * 144 / 9) / 625

    def square(words: tuple[str, ...], key: str, gain: str) -> float:
        values = dict(word.removeprefix("dataset.").split("=") for word in words)
        g = float(values[gain])
        return float(values[key]) ** 2 * (1 + 2 * g / 3 + fourth * g**2)

    by_letter = {factor.letter: factor for factor in made.factors}
    for letter, key, gain in (
        ("C", "texture_strength", "texture_radius_gain"),
        ("N", "rgb_noise", "rgb_noise_radius_gain"),
        ("N", "thermal_noise", "thermal_noise_radius_gain"),
    ):
        low, high = by_letter[letter].low, by_letter[letter].high
        assert square(low, key, gain) == pytest.approx(square(high, key, gain), rel=0.005)
