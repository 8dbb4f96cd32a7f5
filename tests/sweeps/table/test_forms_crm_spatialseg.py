"""Rows of CRM and SpatialSeg in both forms: what each row changes, and which rows are one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from functools import cache
from typing import Any

import pytest

from rgbt.runs.run_spec import RunSpec
from sweeps.table.load_table import load_table
from sweeps.table.table import Form, Row, Table
from sweeps.worker.planner import specify_run

NAMES = (
    *(f"crm/table{number}" for number in ("1", "2a", "2b", "2c", "3a", "3b", "4")),
    *(f"spatialseg/table{number}" for number in range(2, 9)),
)
TABLES = {name: load_table(name) for name in NAMES}
FORMS: tuple[Form, ...] = ("paper", "released")

When = Mapping[str, set[str]]
"""Keys that differ, by a pattern of scale/form."""

SCALES = pytest.mark.parametrize("scale", ["demo", pytest.param("paper", marks=pytest.mark.slow)])

ALWAYS, AT_PAPER = "*/*", "paper/*"
CRM_RELEASED = {"schedule.per", "trainer.selection_split", "transform.colour"}
CRM_SCHEME = {
    "scheme._target_",
    *(f"scheme.{name}_weight" for name in ("complementary", "modality", "nonlocal")),
}
CELLS = {"masker.pairing", "masker.patch_size", "masker.ratio", "masker.sampler"}
GAUSSIAN = {"masker.anchor", "masker.cell_position", "masker.sampler", "masker.sigma_div"}
RECIPE = {"recipe.batch_size", "recipe.eval_every", "recipe.max_steps"}
LENGTH = RECIPE | {
    *("scale.batch_size", "scale.eval_every", "scale.max_steps", "data.batch_size"),
    *("trainer.eval_every", "trainer.max_steps"),
}
"""What a recipe sets at scale=paper."""
SIZES = {"model.depths", "model.embed_dim", "model.num_heads"}
BACKBONES: dict[str, When] = {
    "(Swin-S)": {AT_PAPER: {"model.depths"}},
    "(Swin-B)": {AT_PAPER: {"model.embed_dim", "model.num_heads"}},
}
OURS_KP: When = {
    ALWAYS: {"loss.spatial.alpha"} | GAUSSIAN,
    "*/paper": {"masker.patch_size", "masker.ratio"},
    AT_PAPER: SIZES,
}
"""From CRM with Swin-B to SpatialSeg with Swin-T; the released cells have the size of CRM's."""


def each(labels: list[str], *keys: str) -> dict[str, When]:
    """The same keys for several rows."""
    return {label: {ALWAYS: set(keys)} for label in labels}


CHANGES: dict[str, dict[str, When]] = {
    "crm/table3a": {
        "(1)": {ALWAYS: CRM_SCHEME},
        "(2)": {ALWAYS: CELLS},
        "(3)": {ALWAYS: {"scheme.complementary_weight"}},
        "(4)": {ALWAYS: {"scheme.complementary_weight", "scheme.nonlocal_weight"}},
        "Ours": {ALWAYS: {"scheme.complementary_weight"}},
    },
    "crm/table3b": {
        # The square moves by tokens of 4 pixels, which is a patch of 8 at scale=demo.
        "Patch (8)": {
            ALWAYS: {"masker.sampler"},
            AT_PAPER: {"masker.patch_size"},
        },
        **each(["Patch (16)", "Patch (32)", "Patch (64)"], "masker.patch_size"),
        "Baseline (Table 3a)": {ALWAYS: CELLS | CRM_SCHEME},
    },
    "crm/table4": {
        "IRM 0.3": {ALWAYS: {"masker.pairing", "masker.ratio"}},
        **each([f"IRM 0.{tenths}" for tenths in (4, 5, 6, 7)], "masker.ratio"),
        "CRM as written (Eq. 1)": {ALWAYS: {"masker.pairing", "masker.ratio"}},
    },
    "spatialseg/table2": each(
        ["Person", "Bike", "Curve", "Car Stop", "Guardrail", "Color Cone", "Bump"]
    ),
    "spatialseg/table3": {
        "Ny": {
            ALWAYS: GAUSSIAN | {"masker.patch_size"},
            "*/paper": {"masker.ratio"},
            "demo/*": RECIPE,  # without effect at this scale
            "paper/released": LENGTH,
        },
        **each([f"Ny/{divisor}" for divisor in (2, 4, 8, 16, 32)], "masker.sigma_div"),
    },
    "spatialseg/table4": each(["PS 16", "PS 32", "PS 64"], "masker.patch_size"),
    "spatialseg/table5": each(
        [f"alpha {alpha}" for alpha in (1, 1.5, 2, 2.5, 3)], "loss.spatial.alpha"
    ),
    "spatialseg/table6": {
        "Edge": {ALWAYS: {"loss.spatial.alpha"}},
        "Center": {ALWAYS: {"loss.spatial.focus"}},
    },
    "spatialseg/table7": {
        "Ours (Swin-T)": {
            ALWAYS: {"loss.spatial.alpha", "masker.patch_size"} | GAUSSIAN | RECIPE,
            "*/paper": {"masker.ratio"},
            AT_PAPER: SIZES | LENGTH,
        }
    },
    "spatialseg/table8": {"Ours (Swin-T)": OURS_KP},
}
"""What each row changes of the row above; `BACKBONES` are the same in all tables."""

OTHER_METHOD = {
    *("crm/table1 CMXNet", "crm/table1 Ours", "crm/table2a RTFNet", "crm/table2a CMX"),
    *("crm/table2a Ours (Swin-T)", "crm/table2c RTFNet", "crm/table2c CMX"),
    *("crm/table2c Ours (Swin-T)", "spatialseg/table7 CMX", "spatialseg/table7 CRM (Swin-T)"),
    *("spatialseg/table7 CMNeXt", "spatialseg/table8 CMX", "spatialseg/table8 CRM (Swin-T)"),
}
"""Rows whose method is not that of the row above; network, recipe and loss may differ."""
OF_A_METHOD = {
    *("data", "loss", "masker", "model", "optimizer", "recipe", "scale", "schedule", "scheme"),
    *("trainer", "transform"),
}

FIXED_COUNT = {"masker.anchor", "masker.ratio", "masker.sampler"}
RELEASES: dict[str, When] = {
    "crm/table1 CMXNet": {},  # another recipe, checked by its name
    "crm/table2[ac] MFNet": {ALWAYS: {"transform", "trainer.tested"}},
    "* RTFNet": {ALWAYS: {"transform"}},
    "* CMNeXt": {ALWAYS: {"trainer.selection_split"}},
    "crm/*": {ALWAYS: CRM_RELEASED},
    "spatialseg/table2 *": {ALWAYS: CRM_RELEASED},
    "spatialseg/table3 CRM baseline": {ALWAYS: CRM_RELEASED, AT_PAPER: LENGTH},
    "spatialseg/table8 Ours *": {
        ALWAYS: CRM_RELEASED | {"masker.patch_size", "masker.ratio", "masker.sampler"}
    },
    "spatialseg/table[78] CRM *": {ALWAYS: CRM_RELEASED},
    "spatialseg/*": {ALWAYS: CRM_RELEASED | FIXED_COUNT},
}
"""What the released form changes of a row; the first pattern of table and row that fits. A group
stands for one or more of its keys."""
WITHOUT_RELEASE = {
    *("crm/table2a CMX", "crm/table2c CMX", "spatialseg/table7 CMX", "spatialseg/table8 CMX"),
}
"""Rows that the release cannot run, and those whose experiment is the release already."""


@cache
def specified(overrides: tuple[str, ...]) -> RunSpec:
    return specify_run(overrides)


def spec_of(table: Table, row: Row, scale: str, form: Form) -> RunSpec:
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return specified((*table.overrides(row, scale, form), f"scale={scale}", *rooted))


def leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict) and node:
        for key, child in node.items():
            yield from leaves(child, f"{path}.{key}" if path else key)
    else:
        yield path, node


def changed(one: RunSpec, other: RunSpec) -> set[str]:
    """Keys whose values differ, beside the name of the run."""
    first, second = dict(leaves(one.plain)), dict(leaves(other.plain))
    absent = object()
    keys = first.keys() | second.keys()
    return {key for key in keys if first.get(key, absent) != second.get(key, absent)} - {"name"}


def expected(when: When, scale: str, form: Form) -> set[str]:
    matching = (keys for pattern, keys in when.items() if fnmatch(f"{scale}/{form}", pattern))
    return set().union(*matching)


@SCALES
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", NAMES)
def test_row_changes_the_intended_keys_of_the_row_above(name: str, form: Form, scale: str) -> None:
    table = TABLES[name]
    rows = table.runnable_rows
    for above, row in zip(rows, rows[1:], strict=False):
        found = changed(spec_of(table, above, scale, form), spec_of(table, row, scale, form))
        if f"{name} {row.label}" in OTHER_METHOD:
            groups = {key.partition(".")[0] for key in found}
            assert "model" in groups, row.label
            assert groups <= OF_A_METHOD, row.label
        else:
            backbone = BACKBONES.get(row.label.rpartition(" ")[2])
            when = CHANGES.get(name, {}).get(row.label, backbone)
            assert when is not None, f"{row.label} is not in the list"
            assert found == expected(when, scale, form), row.label


@SCALES
@pytest.mark.parametrize("name", NAMES)
def test_released_form_changes_the_intended_keys(name: str, scale: str) -> None:
    table = TABLES[name]
    for row in table.runnable_rows:
        full = f"{name} {row.label}"
        assert (row.released is None) == (full in WITHOUT_RELEASE), full
        if row.released is None:
            continue
        paper, released = (spec_of(table, row, scale, form) for form in FORMS)
        when = next(when for pattern, when in RELEASES.items() if fnmatch(full, pattern))
        if when:
            keys = expected(when, scale, "released")
            found = {
                key if (group := key.partition(".")[0]) not in keys else group
                for key in changed(paper, released)
            }
            assert found == keys, full
        else:
            assert (paper.name, released.name) == ("cmx", "cmx_released")


@SCALES
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", NAMES)
def test_rows_of_one_run_are_named_by_same_as(name: str, form: Form, scale: str) -> None:
    table = TABLES[name]
    first: dict[tuple[str, ...], str] = {}
    for row in table.runnable_rows:
        metrics = [(column.metric or "").format(**row.settings) for column in table.columns]
        earlier = first.setdefault((spec_of(table, row, scale, form).key, *metrics), row.label)
        if earlier != row.label:
            assert row.same_as == earlier, row.label
        elif scale == "demo":
            assert row.same_as is None, f"{row.label} is a run of its own at both scales"


@pytest.mark.parametrize("name", NAMES)
def test_table_says_what_both_forms_are(name: str) -> None:
    forms = TABLES[name].forms
    assert sorted(forms) == sorted(FORMS)
    assert all(sentence.endswith(".") for sentence in forms.values())
    assert forms["paper"] != forms["released"]


@pytest.mark.parametrize(
    ("cell", "network", "dataset"),
    [
        ("crm/table1 CMXNet", "cmx.model.CMX", "mfnet"),
        ("crm/table2b MFNet", "mfnet.MFNet", "pst900"),
        ("crm/table2b RTFNet-152", "rtfnet.RTFNet", "pst900"),
    ],
)
def test_network_of_a_row_is_described_for_an_evaluation(
    cell: str, network: str, dataset: str
) -> None:
    name, _, label = cell.partition(" ")
    (row,) = (row for row in TABLES[name].rows if row.label == label)
    spec = specified(("scale=paper", *row.network, "dataset.root=/data", "model.weights=file"))
    assert spec.plain["model"]["_target_"] == f"rgbt.models.{network}"
    assert spec.plain["dataset"]["name"] == dataset
    assert spec.plain["model"]["num_classes"] == spec.plain["dataset"]["num_classes"]


def test_rows_with_a_network_are_all_checked() -> None:
    found = {f"{name} {row.label}" for name in NAMES for row in TABLES[name].rows if row.network}
    assert found == {"crm/table1 CMXNet", "crm/table2b MFNet", "crm/table2b RTFNet-152"}


@SCALES
@pytest.mark.parametrize("form", FORMS)
def test_losses_of_the_study_differ_in_their_focus_alone(form: Form, scale: str) -> None:
    study, table6 = load_table("loss_weighting"), TABLES["spatialseg/table6"]
    none, boundary, spatial = (spec_of(study, row, scale, form) for row in study.rows)
    printed = [spec_of(table6, row, scale, form).key for row in table6.rows]
    assert [none.key, spatial.key] == printed[:2]
    assert changed(boundary, spatial) == {"loss.spatial.focus"}
    assert boundary.plain["loss"]["spatial"]["focus"] == "boundary"
    assert boundary.plain["loss"]["spatial"]["alpha"] == 2
