"""The printed numbers of our tables, as transcribed beside the checkout, and their claims."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from sweeps.judge.contrasts import as_claimed, contrasts_of, printed_values
from sweeps.plan.table import PUBLISHED, Row, load_table, table_names

SHARED = Path(os.environ.get("RGBT_SHARED", Path(__file__).resolve().parents[3].parent / "shared"))
FOLDER = SHARED / "published"
PAPERS = ("crm", "multihead", "spatialseg", "temporal")

# The table of the field has no file there: each of its rows names its source.
OURS = {n: load_table(n) for n in table_names(PUBLISHED) if not n.startswith("field/")}

of_reference = pytest.mark.skipif(
    not all((FOLDER / f"{paper}.yaml").is_file() for paper in PAPERS),
    reason="reference material is not here",
)


def one_row_per_cell(table: dict[str, Any]) -> dict[str, Any]:
    """The thesis prints both teachers in one row; each is a run and so a row of ours."""
    words = dict(zip(table["columns"], table["columns_printed"], strict=True))
    whose = {"Ours": "", "Paper": " (HeatNet paper)"}
    rows = [
        {**row, "label": words[column] + whose[row["label"]], "values": {"mIoU": value}}
        for row in table["rows"]
        for column, value in row["values"].items()
    ]
    return {**table, "rows": rows}


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    """Tables that hold numbers, by the name of ours."""
    found: dict[str, Any] = {}
    for paper in PAPERS:
        tables = yaml.safe_load((FOLDER / f"{paper}.yaml").read_text(encoding="utf-8"))["tables"]
        found |= {f"{paper}/{key}": table for key, table in tables.items() if table["rows"]}
    found["multihead/table1"] = one_row_per_cell(found["multihead/table1"])
    return found


def printed_rows(name: str) -> list[Row]:
    """Rows of our table that the paper has; those of ours alone hold no printed value."""
    ours = [row for row in OURS[name].rows if row.origin is None]
    assert not any(row.values for row in ours), name
    return [row for row in OURS[name].rows if row.origin is not None]


def numbers(value: Any) -> Iterator[float | None]:
    """Numbers of a row's values in their order; a cell may hold several."""
    for child in value.values() if isinstance(value, dict) else ():
        yield from numbers(child)
    if not isinstance(value, dict):
        yield value


@of_reference
def test_every_table_with_numbers_is_here(published: dict[str, Any]) -> None:
    assert sorted(published) == sorted(OURS)


@of_reference
@pytest.mark.parametrize("name", OURS)
def test_numbers_and_columns_arrive_unchanged(name: str, published: dict[str, Any]) -> None:
    ours, theirs = printed_rows(name), published[name]["rows"]
    assert [row.label for row in ours] == [row["label"] for row in theirs]
    for row, other in zip(ours, theirs, strict=True):
        assert list(row.values.values()) == list(numbers(other["values"])), row.label
        assert (row.origin, row.proposed) == (other["origin"], other["proposed"]), row.label
    flat = [
        f"{key}_{part}" if part else key
        for key, cell in theirs[0]["values"].items()
        for part in (cell if isinstance(cell, dict) else [""])
    ]
    assert [column.name for column in OURS[name].columns if column.printed] == flat


CONTRADICTED = """
crm/table1 ours_loses_less_without_an_image, spatialseg/table3 ny_edge_loses,
spatialseg/table4 ps64_best_in_all_regions, spatialseg/table5 alpha_improves_edge,
spatialseg/table6 centre_weight_worsens_edge, spatialseg/table8 most_classes_gain,
temporal/table1 views_raise_tc, temporal/table1 con_acc_more_consistent_than_dice,
temporal/table1 dice_on_both_has_lowest_ca, temporal/table4 con_has_best_accuracy,
temporal/table1 proposed_variants_more_consistent_than_cmx,
temporal/table5 resnet50_classes_improve
"""
NOT_PRINTED = """
crm/table3b masks_above_baseline, temporal/table4 cacfnet_has_highest_macc,
temporal/table1 con_has_highest_aligned_consistency,
multihead/table5 modified_decoder_of_text_has_fewer_parameters,
multihead/table5 modified_decoder_of_unused_file_has_fewer_parameters
"""
"""Claims that the printed numbers themselves do not bear out, or do not decide."""


def test_claims_agree_with_printed_numbers_or_are_listed() -> None:
    found = {}
    for name, table in OURS.items():
        for claim in table.claims:
            values = printed_values(table)
            printed = [contrast.of_values(values) for contrast in contrasts_of(claim, table)]
            found[f"{name} {claim.name}"] = as_claimed(claim, printed)
            sizes = [round(abs(value), 1) for value in printed if value is not None]
            for size in re.findall(r"(?:has|gains?) (\d+\.\d)", claim.says):
                assert float(size) in sizes, claim.name
            if name[0] in "cs" and claim.at_most is not None:  # a bound that is not printed
                assert any(f"{claim.at_most:g}" in remark for remark in claim.remarks), claim.name
            if name[0] in "cs" and found[f"{name} {claim.name}"] is False:
                assert any("printed" in remark for remark in claim.remarks), claim.name
    listed: dict[str, bool | None] = {name.strip(): False for name in CONTRADICTED.split(",")}
    listed |= {name.strip(): None for name in NOT_PRINTED.split(",")}
    assert {key: word for key, word in found.items() if word is not True} == listed
