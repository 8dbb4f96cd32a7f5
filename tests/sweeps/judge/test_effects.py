"""Effects of a design from fake runs: which counts are used, differences, missing cells, texts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rgbt.metrics.counts import Counts
from sweeps.judge.effects import MEAN, effects_of
from sweeps.plan.claim import Claim
from sweeps.plan.design import Design, DesignFactor, DesignMethod, Part
from sweeps.plan.table import Column, Row, Table, world_words
from tests.sweeps.judge.accuracies import judged
from tests.sweeps.tabled import counts_of, failed, outcome, table

WHOLE = Part()
"""All combinations of the levels."""

NT = ("noise", "texture")
CELLS = ("N-T-", "N-T+", "N+T-", "N+T+")


def design_table(trained: Part | None = WHOLE, tested: Part | None = None) -> Table:
    levels = {name: {"low": (f"dataset.{name}=0",), "high": (f"dataset.{name}=1",)} for name in NT}
    means = {"low_means": "little", "high_means": "much"}
    baseline = DesignMethod(name="baseline", experiment="baseline")
    design = Design(
        factors=tuple(
            DesignFactor(letter=name[0].upper(), name=name, **levels[name], **means) for name in NT
        ),
        methods=(baseline, DesignMethod(name="crm", experiment="crm", against="baseline")),
        outcomes=("contrast",),
        trained=trained,
        tested=tested,
    )
    columns = (
        Column(name="one", metric="region/1"),
        Column(name="two", metric="region/2"),
        Column(name="contrast", minus=("one", "two")),
    )
    rows = tuple(Row(**row) for row in design.rows())
    return table(rows, columns, design=design)


def with_rates(first: float, second: float) -> Counts:
    """Twelve equal images: shares of the pixels of both classes that are right, by region."""
    right = [round(1000 * first), round(1000 * second)]
    image = [[[share, 1000 - share], [1000 - share, share]] for share in right]
    return counts_of(*[image] * 12, night=None)


def iou(right: float) -> float:
    """Percent of both classes: right / (2 - right)."""
    return 100 * right / (2 - right)


RATES = {"N-T-": 0.9, "N-T+": 0.9, "N+T-": 0.8, "N+T+": 0.8}
"""Of region 1 by the baseline: noise makes it worse. Region 2 is always at 0.9."""

EFFECT = iou(0.8) - iou(0.9)


def trained(seeds: int = 2) -> dict[tuple[str, int], Any]:
    """crm has half of the noise's effect; a seed moves both regions of all cells alike."""
    runs = {}
    for seed in range(seeds):
        for cell, rate in RATES.items():
            moved = 0.01 * seed
            for method, share in (("baseline", rate), ("crm", (rate + 0.9) / 2)):
                label = f"{method} {cell}"
                runs[label, seed] = outcome(
                    f"{label}{seed}", with_rates(share + moved, 0.9 + moved)
                )
    return runs


def estimates(table: Table, runs: Any) -> dict[tuple[str, str, str], Any]:
    frame, _ = effects_of(judged(table, runs))
    return {(line.method, line.against, line.effect): line for line in frame.itertuples()}  # type: ignore[misc]


def test_effects_are_of_contrasts_within_runs() -> None:
    runs = {key: run for key, run in trained().items() if key[1] == 0}
    found = estimates(design_table(), runs)
    assert found["baseline", "", "noise"].value == pytest.approx(EFFECT)
    assert found["baseline", "", "texture"].value == pytest.approx(0)
    assert found["baseline", "", "noise x texture"].value == pytest.approx(0)
    assert found["baseline", "", MEAN].value == pytest.approx(EFFECT / 2)
    own = iou(0.85) - iou(0.9)
    assert found["crm", "", "noise"].value == pytest.approx(own)
    assert found["crm", "baseline", "noise"].value == pytest.approx(own - EFFECT)


def test_method_with_missing_cell_is_named_others_are_analysed() -> None:
    runs = trained()
    for seed in (0, 1):
        runs["crm N+T-", seed] = failed("no memory")
    frame, lacking = effects_of(judged(design_table(), runs))
    assert set(frame["method"]) == {"baseline"}
    assert lacking == ["trained, crm: row 'crm N+T-' has no finished run."]


def test_seeds_that_not_all_cells_have_are_left_out() -> None:
    runs = trained(3)
    runs["baseline N+T+", 2] = failed("no memory")
    found = estimates(design_table(), runs)
    assert found["baseline", "", "noise"].seeds == 2
    assert found["crm", "", "noise"].seeds == 3
    assert found["crm", "baseline", "noise"].seeds == 2


def test_effects_are_shown_by_declared_seeds_alone() -> None:
    """Seed 3 was not declared: the others decide, and where one of these is missing, none does."""
    declaring, name = replace(design_table(), confirm=(0, 1, 2)), ("baseline", "", "noise")
    line = estimates(declaring, trained(4))[name]
    assert (line.seeds, line.shown) == (3, "lower")
    runs = trained(4)
    runs["baseline N+T+", 1] = failed("no memory")
    line = estimates(declaring, runs)[name]
    assert (line.seeds, line.shown) == (1, "explored")
    explored = estimates(design_table(), trained(4))
    assert explored["crm", "baseline", "noise"].shown == "explored"


def claim(letter: str, expected: Any, part: str = "") -> Claim:
    return Claim(
        name="of an effect",
        says="A sentence.",
        source="own",
        rows=("baseline",),
        columns=("contrast",),
        effect=letter,
        part=part,
        expected=expected,
    )


def test_claims_about_effects_are_judged() -> None:
    """Noise makes region 1 worse, and with it the difference of the regions."""
    claims = (claim("N", "lower"), claim("N", "higher"), claim("T", "higher"))
    made = replace(design_table(), claims=claims, confirm=(0, 1, 2))
    found = judged(made, trained(3))
    worse, better, texture = found.claims
    assert [worse.word, better.word] == ["same direction", "opposite direction"]
    assert texture.word == "not shown"
    assert worse.verdict is not None
    assert worse.verdict.estimate == pytest.approx(EFFECT, abs=0.5)
    assert "N+ - N- (trained)" in worse.label
    others = {run: outcome for run, outcome in found.runs.items() if run[0] != "baseline N+T-"}
    assert replace(found, runs=others).claims[0].word == "not run"


def test_claim_is_about_one_part_of_a_design() -> None:
    claims = tuple(claim("N", "lower", part) for part in ("", "tested", "trained"))
    made = replace(design_table(tested=WHOLE), claims=claims, confirm=(0, 1, 2))
    found = judged(made, trained(3)).claims
    assert [claim.word for claim in found] == ["not run", "not run", "same direction"]
    assert "N+ - N- (trained)" in found[-1].label


def test_networks_tested_in_worlds_use_counts_of_each() -> None:
    table = design_table(trained=None, tested=Part())
    worlds = world_words(table.columns[0], table, table.rows[0])
    assert list(worlds) == list(CELLS)
    runs = {}
    for seed in (0, 1):
        made: dict[Any, Counts] = {(): with_rates(0.5, 0.5)}
        made |= {worlds[cell]: with_rates(rate, 0.9) for cell, rate in RATES.items()}
        runs["baseline natural", seed] = outcome(f"run{seed}", made)
    found = estimates(table, runs)
    assert found["baseline", "", "noise"].value == pytest.approx(EFFECT)
    assert ("crm", "", "noise") not in found


def test_corrupted_images_of_worlds_have_counts_of_their_own() -> None:
    """Noise makes the intact images worse, and those without RGB better."""
    made = design_table(trained=None, tested=Part())
    without = Column(name="two", metric="region/1", corruption="removed:rgb")
    made = replace(made, columns=(made.columns[0], without, made.columns[2]))
    intact, removed = (world_words(column, made, made.rows[0]) for column in made.columns[:2])
    runs = {}
    for seed in (0, 1):
        counts: dict[Any, Counts] = {(): with_rates(0.5, 0.5)}
        for cell, rate in RATES.items():
            counts[intact[cell]] = with_rates(rate, 0.9)
            counts[removed[cell]] = with_rates(1.3 - rate, 0.9)
        runs["baseline natural", seed] = outcome(f"run{seed}", counts)
    found = estimates(made, runs)
    intact_effect, removed_effect = iou(0.8) - iou(0.9), iou(0.5) - iou(0.4)
    assert found["baseline", "", "noise"].value == pytest.approx(intact_effect - removed_effect)
