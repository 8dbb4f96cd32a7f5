"""The table of other authors' networks: printed numbers with sources and lists, never a ranking."""

from __future__ import annotations

import re

import pytest

from rgbt.config.compose import available, compose
from rgbt.config.stored_config import EXTERNAL
from sweeps.plan.table import Row, load_table

TABLE = load_table("field/2026")
SOURCE = re.compile(r"README of [\w.-]+/[\w.-]+|arXiv \d{4}\.\d{5}, |\w+ 20\d\d, .*, abstract")


@pytest.mark.parametrize("row", TABLE.rows, ids=lambda row: row.label)
def test_a_row_has_a_printed_number_and_its_source(row: Row) -> None:
    assert row.experiment is None
    assert row.origin == "printed"
    assert 0 < (row.values["mIoU"] or 0) < 100
    assert SOURCE.match(row.remarks[0])


@pytest.mark.parametrize("row", [row for row in TABLE.rows if row.network], ids=lambda r: r.label)
def test_the_network_of_a_row_is_a_recipe_whose_readme_has_the_number(row: Row) -> None:
    recipe = row.network[0].removeprefix("model=external/")
    assert recipe in available("model/external")
    node = compose([*row.network, "dataset=mfnet", "dataset.root=/data"]).model
    assert node._target_ == EXTERNAL
    arguments = node.arguments
    assert arguments.num_classes == 9
    # ConvNeXt V2: the widths of its four stages double, from that of its size.
    first = {"nano": 80, "tiny": 96, "base": 128}[arguments.rgb_arch.partition("_")[2]]
    assert list(arguments.context_dim) == [first * 2**stage for stage in range(4)]
    assert arguments.ir_arch == arguments.rgb_arch


def test_no_claim_compares_the_rows() -> None:
    assert TABLE.claims == ()
    assert "do not rank" in str(TABLE.remarks[0])
