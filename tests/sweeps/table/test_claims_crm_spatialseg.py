"""Claims of CRM and SpatialSeg against the printed numbers, and the facts beside their tables."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.types import MaskPair
from sweeps.table.claim import Claim
from sweeps.table.load_table import load_table
from sweeps.table.table import Table

NAMES = (
    *(f"crm/table{number}" for number in ("1", "2a", "2b", "2c", "3a", "3b", "4")),
    *(f"spatialseg/table{number}" for number in range(2, 9)),
)
TABLES = {name: load_table(name) for name in NAMES}
CLAIMS = [(name, claim) for name in NAMES for claim in TABLES[name].claims]

CONTRADICTED = {
    "crm/table1 ours_loses_less_without_an_image",
    "spatialseg/table3 ny_edge_loses",
    "spatialseg/table4 ps64_best_in_all_regions",
    "spatialseg/table5 alpha_improves_edge",
    "spatialseg/table6 centre_weight_worsens_edge",
    "spatialseg/table8 most_classes_gain",
}
"""Claims that the printed numbers themselves do not bear out."""

PRINTED_ELSEWHERE = {"Baseline (Table 3a)": {"mIoU": 59.5}}
SHARES = (89, 66, 29, 7.9, 1.4, 0.003)
"""Percent of RGB cells that the masks of the text hide, in the remarks of Table III."""


def printed_contrasts(table: Table, claim: Claim) -> list[float]:
    """The contrasts of a claim, of printed values; without those that have a dash."""
    values = {row.label: dict(row.values) for row in table.rows}
    for label in values.keys() & PRINTED_ELSEWHERE.keys():
        values[label] |= PRINTED_ELSEWHERE[label]

    def score(label: str, column: str) -> float | None:
        value = values[label].get(column)
        if value is None or claim.minus_column is None:
            return value
        other = values[label][claim.minus_column]
        return None if other is None else value - other

    contrasts = []
    for label, other in claim.pairs(list(values)):
        for column in claim.columns:
            pair = (score(label, column), 0.0 if other is None else score(other, column))
            if pair[0] is not None and pair[1] is not None:
                contrasts.append(round(pair[0] - pair[1], 6))
    return contrasts


def agrees(claim: Claim, contrasts: list[float]) -> bool:
    least, most = claim.range
    fitting = [least < each < most for each in contrasts]
    mean = sum(contrasts) / len(contrasts)
    return {
        "all": all(fitting),
        "any": any(fitting),
        "most": 2 * sum(fitting) > len(fitting),
        "mean": least < mean < most,
    }[claim.combine]


@pytest.mark.parametrize(
    ("name", "claim"), [pytest.param(*each, id=f"{each[0]}: {each[1].name}") for each in CLAIMS]
)
def test_claim_agrees_with_printed_numbers_or_is_listed(name: str, claim: Claim) -> None:
    is_listed = f"{name} {claim.name}" in CONTRADICTED
    assert agrees(claim, printed_contrasts(TABLES[name], claim)) != is_listed
    if is_listed:
        assert any("printed" in remark for remark in claim.remarks)


def test_contradicted_claims_exist() -> None:
    assert {f"{name} {claim.name}" for name, claim in CLAIMS} >= CONTRADICTED


def test_sizes_in_claims_are_printed_differences() -> None:
    checked = 0
    for name, claim in CLAIMS:
        for size in re.findall(r"(?:has|gains?) (\d+\.\d)", claim.says):
            sizes = [round(abs(each), 1) for each in printed_contrasts(TABLES[name], claim)]
            assert float(size) in sizes, (name, claim.name)
            checked += 1
    assert checked == 10


def test_bounds_of_claims_without_a_printed_size_are_explained() -> None:
    for name, claim in CLAIMS:
        if claim.at_most is not None:
            assert any(f"{claim.at_most:g}" in remark for remark in claim.remarks), (name, claim)


@pytest.mark.parametrize("name", NAMES)
def test_texts_of_a_table_are_short_sentences(name: str) -> None:
    table = TABLES[name]
    texts = [*table.forms.values(), *(claim.says for claim in table.claims)]
    texts += [remark for claim in table.claims for remark in claim.remarks]
    texts += [text for row in table.rows if row.released for text in row.released.remarks]
    for sentence in (each for text in texts for each in re.split(r"(?<=\.) ", text)):
        assert len(sentence.split()) <= 25, sentence


def masks_of_text(divisor: int, samples: int) -> MaskPair:
    """Masks as Eqs. 6 to 11 of SpatialSeg draw them for a crop of MFNet, before the patterns."""
    overrides = ["masker=grbm_paper", f"masker.sigma_div={divisor}", "masker.pairing=comp"]
    masker = build(compose([*overrides, "scale=paper", "dataset.root=/data"]).masker)
    centres = torch.tensor([[120, 160]]).expand(samples, 2)
    masks: MaskPair = masker((240, 320), centres, torch.Generator().manual_seed(0))
    return masks


@pytest.mark.parametrize(("divisor", "share"), list(zip((1, 2, 4, 8, 16, 32), SHARES, strict=True)))
def test_share_of_hidden_rgb_cells_is_the_one_in_the_remarks(divisor: int, share: float) -> None:
    # Eq. 8 on the 4 x 5 cells of the padded crop of 256 x 320 pixels, written out.
    rows, columns = np.mgrid[0:4, 0:5]
    square = (rows - 2.0) ** 2 + (columns - 2.5) ** 2
    exact = np.exp(-square / (2 * (4 / divisor) ** 2)).mean()
    assert float(f"{100 * exact:.{1 if share < 0.01 else 2}g}") == share
    masks = masks_of_text(divisor, 4000)
    deviation = np.sqrt(exact * (1 - exact) / masks.rgb.numel())
    assert masks.rgb.float().mean().item() == pytest.approx(exact, abs=5 * deviation)
    assert torch.equal(masks.thermal, ~masks.rgb)


def test_remarks_hold_the_shares() -> None:
    text = " ".join(TABLES["spatialseg/table3"].remarks)
    assert "89, 66, 29, 7.9, 1.4 and 0.003 %" in text
