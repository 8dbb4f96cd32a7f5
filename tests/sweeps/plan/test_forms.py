"""Rows of the papers' tables in both forms: what each changes, which are one run, what is said."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatch
from functools import cache
from typing import Any, get_args

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.config.component import build
from rgbt.config.compose import flatten
from rgbt.config.overrides import composing
from rgbt.runs.run_spec import RunSpec
from sweeps.plan.planner import Planner, specify_run
from sweeps.plan.request import TableRequest, check_equal_runs
from sweeps.plan.table import PUBLISHED, STUDIES, Form, Row, Table, load_table, table_names
from sweeps.score.efficiency import million_parameters
from tests.composed import specified

TABLES = {name: load_table(name) for name in table_names(PUBLISHED)}
FORMS: tuple[Form, ...] = get_args(Form)
SLOW = pytest.mark.slow
MANY_ROWS = {"multihead/table3", "multihead/table4"}
"""Tables whose rows take several seconds to compose."""

SECOND = {"none": [], "dice": ["dice2"], "con": ["con"], "con_acc": ["con-acc"]}
"""Losses of the second view by the setting of the loss of Temporal."""

IGNORED = ("name", "seed", "consistency", "recipe", "scale")
"""Nodes that are not compared: labels, evaluations, and what other nodes take their values from."""

ANOTHER = "another method"
"""Of a row whose network is another one than that of the row above; all else may differ too."""

SIZES = "data.batch_size trainer.eval_every trainer.max_steps"
CELLS = "masker.pairing masker.patch_size masker.ratio masker.sampler"
GAUSSIAN = "masker.anchor masker.cell_position masker.sampler masker.sigma_div"
SWIN = {"(Swin-S)": "| model.depths", "(Swin-B)": "| model.embed_dim model.num_heads"}
SMALLER = "model.depths model.embed_dim model.num_heads"
OURS = f"loss.spatial.alpha {GAUSSIAN}"
CMX_INPUTS = (
    "model.inputs.rgb_mean model.inputs.rgb_order model.inputs.rgb_std model.inputs.thermal_mean "
    "model.inputs.thermal_scale model.inputs.thermal_std model.decoder_norm_eps_eval transform"
)
"""Between CMX as its own release trains it and CMX of Temporal."""
LATE_POLY = "schedule.counted_steps schedule.epoch_steps schedule.epochs"
RELEASED_CMX = f"loss scheme {CMX_INPUTS} {LATE_POLY} | {SIZES} schedule.warmup_steps"
FIRST_CON = f"loss scheme // {RELEASED_CMX}"
TWO_HEADS = "domains.source.head domains.target.head domains.target_is model.heads"
DECODER = "model.align_corners model.ceil_mode model.decoder"
ONE_HEAD = "loss model.auxiliary model.weights scheme transform.blur_probability"
NIGHT_LABELS = "domains.target.confidence domains.target.labels domains.target.teacher_view"

EXPECTED: dict[str, dict[str, str]] = {
    "crm/table1": {"CMXNet": ANOTHER, "Ours": ANOTHER},
    **dict.fromkeys(
        ("crm/table2a", "crm/table2c"),
        dict.fromkeys(("RTFNet", "CMX", "Ours (Swin-T)"), ANOTHER) | {"Ours": "Swin"},
    ),
    "crm/table2b": {"Ours": "Swin"},
    "crm/table3a": {
        "(1)": "scheme",
        "(2)": CELLS,
        "(3)": "scheme.complementary_weight",
        "(4)": "scheme.complementary_weight scheme.nonlocal_weight",
        "Ours": "scheme.complementary_weight",
    },
    "crm/table3b": {
        # The square moves by tokens of 4 pixels, which is a patch of 8 at scale=demo.
        "Patch (8)": "masker.sampler | masker.patch_size",
        **dict.fromkeys(("Patch (16)", "Patch (32)", "Patch (64)"), "masker.patch_size"),
        "Baseline (Table 3a)": f"{CELLS} scheme",
    },
    "crm/table4": {
        "IRM 0.3": "masker.pairing masker.ratio",
        **dict.fromkeys([f"IRM 0.{tenths}" for tenths in (4, 5, 6, 7)], "masker.ratio"),
        "CRM as written (Eq. 1)": "masker.pairing masker.ratio",
    },
    "spatialseg/table2": dict.fromkeys(
        ("Person", "Bike", "Curve", "Car Stop", "Guardrail", "Color Cone", "Bump"), ""
    ),
    "spatialseg/table3": {
        "Ny": f"{GAUSSIAN} masker.patch_size masker.ratio"
        f" // {GAUSSIAN} masker.patch_size | {SIZES}",
        **dict.fromkeys([f"Ny/{divisor}" for divisor in (2, 4, 8, 16, 32)], "masker.sigma_div"),
    },
    "spatialseg/table4": dict.fromkeys(("PS 16", "PS 32", "PS 64"), "masker.patch_size"),
    "spatialseg/table5": dict.fromkeys(
        [f"alpha {alpha}" for alpha in (1, 1.5, 2, 2.5, 3)], "loss.spatial.alpha"
    ),
    "spatialseg/table6": {"Edge": "loss.spatial.alpha", "Center": "loss.spatial.focus"},
    "spatialseg/table7": {
        **dict.fromkeys(("CMX", "CMNeXt", "CRM (Swin-T)"), ANOTHER),
        "CRM": "Swin",
        "Ours": "Swin",
        "Ours (Swin-T)": f"{OURS} masker.patch_size masker.ratio | {SIZES} {SMALLER}"
        f" // {OURS} masker.patch_size | {SIZES} {SMALLER}",
    },
    "spatialseg/table8": {
        **dict.fromkeys(("CMX", "CRM (Swin-T)"), ANOTHER),
        "CRM": "Swin",
        "Ours": "Swin",
        "Ours (Swin-T)": f"{OURS} masker.patch_size masker.ratio | {SMALLER} // {OURS} | {SMALLER}",
    },
    "temporal/table1": {
        "(B)": FIRST_CON,
        "(C)": "loss.beta loss.second",
        **dict.fromkeys(("(D)", "(E)", "(H)", "(I)"), "loss.second"),
        "(F)": "loss.alpha loss.beta loss.second",
        "(G)": "loss.beta loss.second",
    },
    "temporal/table2": {
        "(B)": FIRST_CON,
        **dict.fromkeys(("(C)", "(D)"), "scheme.view.mode"),
    },
    "temporal/table3": {
        **dict.fromkeys(("(B)", "(C)", "(E)", "(F)", "(H)", "(I)"), "loss.beta"),
        **dict.fromkeys(("(D)", "(G)"), "loss.alpha loss.beta"),
    },
    "temporal/table4": {
        "CMX (MiT-B2)": ANOTHER,
        "CMX (MiT-B4)": "| model.depths",
        "CMNeXt": ANOTHER,
        "Ours-dice": ANOTHER,
        **dict.fromkeys(("Ours-con", "Ours-con-acc"), "loss.second"),
    },
    "temporal/table5": {
        **dict.fromkeys(
            ("Ours-con (ResNet-50)", "Ours-con (ResNet-152)"),
            "loss scheme // loss scheme transform",
        ),
        "RTFNet (ResNet-152)": f"loss scheme | {SIZES} model.depth schedule.epoch_steps"
        f" // loss scheme transform | {SIZES} model.depth schedule.epoch_steps",
    },
    "multihead/table1": {"Thermal teacher": "model.modalities"},
    "multihead/table2": {
        "HeatNet (reproduced)": (
            f"{NIGHT_LABELS} scheme.supervise_target scheme.weighed_by_confidence"
        ),
        "HeatNet RGB-only (reproduced)": (
            f"{NIGHT_LABELS} model.modalities scheme trainer.max_steps"
        ),
    },
    "multihead/table3": {
        "SH-Adv": f"{ONE_HEAD} | {SIZES}",
        "SH-Adv(Seg. on IR)": "model.weights",
        "Multi-head": f"{TWO_HEADS} model.weights | {SIZES}",
        "Multi-head*": f"{DECODER} model.weights | model.dropout",
        "HeatNet*": ANOTHER,
        "RGB alone": ANOTHER,
        "SH, first stage with labels on IR": "domains.source.view domains.target scheme",
        "Multi-head, first stage": f"{TWO_HEADS} | {SIZES}",
    },
    "multihead/table4": {
        "Multi-head*": f"{DECODER} model.weights | {SIZES} model.dropout",
        "Multi-head**": f"model.weights | {SIZES}",
        "HeatNet RGB-only*": ANOTHER,
        "RGB by day alone": ANOTHER,
        "Multi-head, first stage": (
            "domains.source.head domains.source.view domains.target domains.target_is model.heads "
            f"scheme | {SIZES}"
        ),
        "Multi-head, labels kept": "model.weights scheme | trainer.max_steps",
        "Multi-head, labels kept, no critic": "scheme",
    },
    "multihead/table5": {
        "Multi-head network": ANOTHER,
        "Multi-head*, decoder as in the text": (
            f"{DECODER} model.weights | {SIZES} | model.base_width model.depths model.rates "
            "model.summed_rates"
        ),
        "Multi-head*, decoder of the unused file": "model.decoder model.dropout",
    },
}
"""Settings in which a row differs from the row above it that is run: at both scales | at
scale=paper too | at scale=demo too // the same in the released form, where that differs. A
component that is replaced by another is one setting."""

CRM_RELEASED = "schedule.per trainer.selection_split transform.colour"
FIXED_COUNT = "masker.anchor masker.ratio masker.sampler"
RELEASES = {
    "crm/table1 CMXNet": ANOTHER,
    "crm/table2[ac] MFNet": "transform trainer.tested",
    "* RTFNet": "transform",
    "* CMNeXt": "trainer.selection_split",
    "spatialseg/table3 CRM baseline": f"{CRM_RELEASED} | {SIZES}",
    "spatialseg/table8 Ours *": (f"{CRM_RELEASED} masker.patch_size masker.ratio masker.sampler"),
    "spatialseg/table[78] CRM *": CRM_RELEASED,
    **dict.fromkeys(("crm/*", "spatialseg/table2 *"), CRM_RELEASED),
    "spatialseg/*": f"{CRM_RELEASED} {FIXED_COUNT}",
}
"""What the released form changes of a row; the first pattern of table and row that fits."""


@cache
def runs(name: str, form: Form, scale: str) -> Mapping[str, RunSpec]:
    """The run of every row of a table that can be run, by its label, in the order of the table."""
    table = TABLES[name]
    return {row.label: run_of(table, row, form, scale) for row in table.runnable_rows}


def run_of(table: Table, row: Row, form: Form, scale: str) -> RunSpec:
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return specified((*table.overrides(row, scale, form), f"scale={scale}", *rooted))


def difference(one: RunSpec, other: RunSpec) -> set[str]:
    """Keys in which two runs differ; of a component of another class, its node alone."""
    first, second = (
        {
            key: value
            for key, value in flatten(run.plain).items()
            if key.split(".")[0] not in IGNORED
        }
        for run in (one, other)
    )
    keys = {key for key in {*first, *second} if first.get(key) != second.get(key)}
    replaced = sorted(key.removesuffix("._target_") for key in keys if key.endswith("._target_"))
    return {
        next((node for node in replaced if key == node or key.startswith(f"{node}.")), key)
        for key in keys
    }


def check_difference(found: set[str], text: str, scale: str, what: str) -> None:
    """Compare settings with their notation; a node stands for one or more of its settings."""
    if text == ANOTHER:
        assert any(key.startswith("model") for key in found), what
        return
    both, at_paper, at_demo, *_ = *text.split("|"), "", ""
    words = f"{both} {at_paper if scale == 'paper' else at_demo}".split()
    nodes = {key: [word for word in words if f"{key}.".startswith(f"{word}.")] for key in found}
    assert {word for key in found for word in nodes[key] or [key]} == set(words), what


# Rows of several releases differ in more than a row is about.
SEVERAL = [(name, "released") for name in ("multihead/table3", "multihead/table4")]


class Composed(Planner):
    """A planner that shares what other tests have composed."""

    def specify(self, overrides: tuple[str, ...], *, checked: bool = True) -> RunSpec:
        scaled = [word for word in overrides if word.startswith("scale=")] or ["scale=demo"]
        rooted = [word for word in overrides if word.startswith("dataset.root=")]
        others = [word for word in overrides[:-1] if word not in (*scaled, *rooted)]
        with composing(overrides):
            return specified((*others, *scaled, *rooted))


@pytest.mark.parametrize(
    ("name", "scale"),
    [
        pytest.param(name, scale, marks=[SLOW] if scale != "demo" or name in MANY_ROWS else [])
        for name in (*TABLES, *table_names(STUDIES))
        for scale in ("demo", "bench", "paper")
    ],
)
def test_rows_of_a_table(name: str, scale: str) -> None:
    """Each row is composed once: a third of the time of most tests."""
    # What a command checks of the tables of a user alone.
    extra = ("dataset.root=/data",) if scale == "paper" and name in TABLES else ()
    for form in FORMS:
        request = TableRequest(name, load_table(name), scale, (0,), extra, form=form)
        check_equal_runs(request, Composed())
    if name not in TABLES or scale == "bench":
        return
    paper, released = (runs(name, form, scale) for form in FORMS)
    for form, found in zip(FORMS, (paper, released), strict=True):
        if name in EXPECTED and (name, form) not in SEVERAL:
            check_rows_above(name, form, scale, found)
    for row in TABLES[name].runnable_rows:
        is_same = paper[row.label].key == released[row.label].key
        assert scale == "paper" or is_same == (row.released is None), row.label
        if row.released is not None and name[0] in "cs":
            full = f"{name} {row.label}"
            text = next(text for pattern, text in RELEASES.items() if fnmatch(full, pattern))
            check_difference(difference(paper[row.label], released[row.label]), text, scale, full)
        if row.same_as and scale == "demo":
            assert paper[row.label].key == paper[row.same_as].key
        if scale == "demo":
            check_printed_settings(name, row, OmegaConf.create(dict(paper[row.label].plain)))


def check_rows_above(name: str, form: Form, scale: str, found: Mapping[str, RunSpec]) -> None:
    """A row differs from the row above it in the intended settings."""
    for above, label in zip(found, list(found)[1:], strict=False):
        paper, _, released = EXPECTED[name].get(label, "Swin").partition(" // ")
        text = released or paper if form == "released" else paper
        text = SWIN[label.rpartition(" ")[2]] if text == "Swin" else text
        check_difference(difference(found[label], found[above]), text, scale, label)


def assert_printed(row: Row, found: dict[str, Any]) -> None:
    """What is found of a row's configuration is what the paper prints about it."""
    printed = {key: value for key, value in row.settings.items() if value is not None}
    shared = set(printed) & set(found)
    assert {key: printed[key] for key in shared} == {key: found[key] for key in shared}


def check_printed_settings(name: str, row: Row, config: DictConfig) -> None:
    masker, loss = config.masker, config.loss
    assert min(build(masker).grid_hw(tuple(config.transform.crop_hw))) > 1
    found = {
        "patch_size": 2 * (masker.patch_size or 0),  # pixels are halved at demo scale
        "alpha": loss.get("spatial", loss).get("alpha"),
        "beta": loss.get("beta"),
        "focus": loss.get("spatial", {}).get("focus"),
        "masking_ratio": masker.ratio,
        "masking": {"indiv": "irm", "rand_comp": "crm", "comp": "crm_pair"}.get(
            masker.pairing or ""
        ),
    }
    if masker.sigma_div is not None:
        found["sigma_p"] = "Ny" if masker.sigma_div == 1 else f"Ny/{masker.sigma_div:g}"
    assert_printed(row, found)
    if not name.startswith("temporal"):
        return
    first, second = ["seg1"], []
    if "second" in loss:
        first += ["dice1"] if loss.alpha else []
        second = ["seg2", *SECOND[loss.second]]
        assert bool(loss.beta) == (loss.second != "none")
        assert loss.form == "paper"
    assert (row.settings["losses_img1"], row.settings["losses_img2"]) == (first, second)
    assert row.settings["network"] in config.model["_target_"].lower()
    mode = config.scheme.view.mode if "view" in config.scheme else "neither"
    views = {"rotation": ("rotation", "both"), "translation": ("translation", "both")}
    if name == "temporal/table2":
        assert_printed(row, {key: mode in modes for key, modes in views.items()})


TWICE = (
    "spatialseg/table3 Ny/4 | spatialseg/table4 PS 64 | spatialseg/table5 alpha 0"
    " | spatialseg/table6 no weighting",
    "spatialseg/table5 alpha 2 | spatialseg/table6 Edge | spatialseg/table7 Ours (Swin-S)",
    "crm/table1 Ours | crm/table2a Ours (Swin-S) | crm/table3a Ours | crm/table3b Patch (32)"
    " | crm/table4 CRM",
    "temporal/table1 (A) | temporal/table2 (A)",
    "temporal/table1 (G) | temporal/table4 Ours-dice",
    "temporal/table1 (H) | temporal/table2 (D) | temporal/table3 (E) | temporal/table4 Ours-con",
    "temporal/table1 (I) | temporal/table4 Ours-con-acc",
    "multihead/table2 HeatNet (reproduced) | multihead/table3 HeatNet*",
    "multihead/table2 HeatNet RGB-only (reproduced) | multihead/table4 HeatNet RGB-only*",
)
MAIN = ("mIoU", "rgbt_mIoU", "mIoU_day", "mIoU_rgb")


@pytest.mark.parametrize("scale", ["demo", pytest.param("paper", marks=SLOW)])
def test_rows_printed_twice_are_one_run(scale: str) -> None:
    for cells in TWICE:
        keys, printed = set(), set()
        for name, _, label in (cell.partition(" ") for cell in cells.split(" | ")):
            (row,) = (row for row in TABLES[name].rows if row.label == label)
            keys.add(run_of(TABLES[name], row, "paper", scale).key)
            value = next(row.values[key] for key in MAIN if row.values.get(key) is not None)
            assert value is not None
            printed.add(round(value, 1))
        assert (len(keys), len(printed)) == (1, 1), cells


def upstream_names(run: RunSpec) -> set[str]:
    """Names of all upstream runs, those of upstream runs included."""
    return {other.name for other in run.upstream}.union(*map(upstream_names, run.upstream))


def test_upstream_runs_of_released_rows_are_released() -> None:
    """Earlier stages, and the teachers of pseudo-labels."""
    found = {
        f"{name} {row.label}": upstream_names(runs(name, "released", "demo")[row.label])
        for name in ("multihead/table2", "multihead/table3", "multihead/table4")
        for row in TABLES[name].runnable_rows
        if row.released is not None
    }
    stage, teacher = "multi_head_{}_stage1_released".format, "thermal_teacher_semseg"
    assert {key: names for key, names in found.items() if names} == {
        "multihead/table2 HeatNet (reproduced)": {teacher},
        "multihead/table2 HeatNet RGB-only (reproduced)": {"heatnet_released", teacher},
        "multihead/table3 SH-Maximum squares loss": {"sh_max_squares_stage1_released"},
        "multihead/table3 Multi-head*": {stage("thermal")},
        "multihead/table3 HeatNet*": {teacher},
        "multihead/table4 Multi-head": {teacher},
        "multihead/table4 Multi-head*": {stage("night"), teacher},
        "multihead/table4 Multi-head**": {stage("night_init"), stage("thermal"), teacher},
        "multihead/table4 HeatNet RGB-only*": {"heatnet_released", teacher},
    }


# Table and row -> per stage batch size and steps of 12,170 pairs: 50 and 100 epochs.
STARRED = {
    ("multihead/table3", "Multi-head*"): ((16, 50 * 761), (16, 100 * 761)),
    ("multihead/table4", "Multi-head*"): ((8, 50 * 1522), (8, 100 * 1522)),
    ("multihead/table4", "Multi-head**"): ((16, 50 * 761), (16, 100 * 761)),
}


@pytest.mark.parametrize(("name", "label"), STARRED)
def test_released_starred_rows_train_basic_network_in_two_stages(name: str, label: str) -> None:
    """The scripts import the basic network; the modified decoder is that of the paper's form."""
    (row,) = (row for row in TABLES[name].rows if row.label == label)
    paper, second = (run_of(TABLES[name], row, form, "paper") for form in FORMS)
    assert paper.model.plain["decoder"] == "modified_heatnet"
    (first,) = (
        dependency.run for dependency in second.dependencies if dependency.key == "model.weights"
    )
    for run, sizes, gradients in zip(
        (first, second), STARRED[name, label], ("kept", "together"), strict=True
    ):
        assert run.model.plain["decoder"] == "basic"
        assert list(run.model.plain["heads"]) == ["source", "target"]
        assert (run.data.batch_size, run.trainer.max_steps) == sizes
        assert run.scheme.plain["gradients"] == gradients


NETWORKS = {
    row.network: name
    for name, table in TABLES.items()
    for row in table.rows
    if row.network and name != "field/2026"  # networks of checkouts
}
MILLIONS = {
    "cmx_b2": 66.57,
    "cmx_b4": 139.86,
    "rtfnet_50": 185.24,
    "cmnext_b4": 116.56,
    "rtfnet_152": 254.51,
    "heatnet": 54.36,
    "heatnet_rgb": 53.32,
    "mfnet": 0.735,
}
"""Parameters as the releases have them, with the classes of the data set."""


@pytest.mark.parametrize("network", NETWORKS, ids=" ".join)
def test_network_for_weights_is_the_published_one(network: tuple[str, ...]) -> None:
    words = ("scale=paper", *network, "dataset.root=/data")
    run = specify_run(words)
    papers = {"temporal": "mfnet", "multihead": "freiburg", "crm": "mfnet"}
    expected = papers[NETWORKS[network].partition("/")[0]]
    expected = "pst900" if "dataset=pst900" in network else expected
    assert run.dataset.plain["name"] == expected
    assert run.model.plain["num_classes"] == run.dataset.plain["num_classes"]
    model = next(word for word in network if word.startswith("model=")).removeprefix("model=")
    assert million_parameters(tuple(words)) == pytest.approx(MILLIONS[model], rel=1e-3)
    inputs = run.model.plain["inputs"]
    if "cmx" in model:  # the public weights
        assert (inputs["rgb_order"], run.model.plain["decoder_norm_eps_eval"]) == ("bgr", 1e-5)


@pytest.mark.parametrize("number", [3, 4, 5, 6])
def test_printed_variance_is_the_population_variance_of_the_rings(number: int) -> None:
    for row in TABLES[f"spatialseg/table{number}"].rows:
        rings = [row.values[f"IoU{ring}"] for ring in range(1, 6)]
        mean = sum(value for value in rings if value is not None) / 5
        variance = sum((value - mean) ** 2 for value in rings if value is not None) / 5
        printed = row.values["Var"]
        assert printed is not None
        assert (abs(variance - printed) > 0.02) == ("Var" in row.doubtful), (row.label, variance)


@pytest.mark.parametrize("number", [2, 3, 4])
def test_printed_mean_is_that_of_both_columns(number: int) -> None:
    table = TABLES[f"multihead/table{number}"]
    mean = next(column for column in table.columns if column.name == "mean_mIoU")
    for row in table.rows:
        known = [row.values.get(name) for name in (*mean.sources, "mean_mIoU")]
        if None not in known:
            first, second, printed = (value or 0.0 for value in known)
            assert printed == pytest.approx((first + second) / 2, abs=0.0501), row.label
