"""Both forms of the rows of Temporal and of the thesis: which runs they are, and what differs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pytest

from rgbt.config.compose import flatten
from rgbt.runs.run_spec import RunSpec
from sweeps.table.efficiency import million_parameters
from sweeps.table.load_table import load_table, table_names
from sweeps.table.request import TableRequest
from sweeps.table.table import Form, Row, Table
from sweeps.worker.planner import specify_run
from tests.composed import specified

TABLES = {
    name: load_table(name)
    for name in table_names(Path("none"))
    if name.startswith(("temporal", "multihead"))
}
SCALES = ("demo", "paper")
FORMS: tuple[Form, ...] = get_args(Form)

IGNORED = ("name", "seed", "consistency", "recipe", "scale")
"""Nodes that are not compared: labels, evaluations, and what other nodes take their values from."""

SIZES = "data.batch_size trainer.eval_every trainer.max_steps"
"""Batch size and durations, which differ at scale=paper only."""

CMX_INPUTS = (
    "model.inputs.rgb_mean model.inputs.rgb_order model.inputs.rgb_std model.inputs.thermal_mean "
    "model.inputs.thermal_scale model.inputs.thermal_std model.decoder_norm_eps_eval transform"
)
"""Between CMX as its own release trains it and CMX of Temporal."""

LATE_POLY = "schedule.counted_steps schedule.epoch_steps schedule.epochs"
TWO_HEADS = "domains.source.head domains.target.head domains.target_is model.heads"
DECODER = "model.align_corners model.ceil_mode model.decoder"
ANOTHER_RECIPE = "model optimizer schedule trainer.max_steps"
NIGHT_LABELS = "domains.target.confidence domains.target.labels domains.target.teacher_view"
CRITIC = (
    "scheme.alternates scheme.both_ways scheme.critic.upsample scheme.critic_optimizer "
    "scheme.judged scheme.source_value scheme.supervise_target scheme.target_value "
    "scheme.weighed_by_confidence"
)
"""Between the discriminators of the thesis and of HeatNet."""
HEATNET = (
    f"{ANOTHER_RECIPE} {CRITIC} {NIGHT_LABELS} domains.source.head domains.source.view "
    "domains.target.head domains.target.view domains.target_is"
)
STUDENT = (
    f"{ANOTHER_RECIPE} scheme domains.source.head domains.source.view domains.target.head "
    "domains.target.labels domains.target.view domains.target_is"
)
TESTED = "dataset.ignored_test trainer.selection_split trainer.tested transform.label_resize"
"""Of rows that are not in the paper: the released form does not change them."""

COUNTED = "prediction.counted prediction.label_resize"
"""Between the evaluations of the thesis' port of HeatNet and of all others."""

LOSSES = {
    **{"(C)": "loss.beta loss.second", "(D)": "loss.second", "(E)": "loss.second"},
    **{"(F)": "loss.alpha loss.beta loss.second", "(G)": "loss.beta loss.second"},
    **{"(H)": "loss.second", "(I)": "loss.second"},
}
RELEASED_CMX = f"loss scheme {CMX_INPUTS} {LATE_POLY} | {SIZES} schedule.warmup_steps"
MOTIONS = {"(C)": "scheme.view.mode", "(D)": "scheme.view.mode"}
WEIGHTS = {
    label: "loss.alpha loss.beta" if label in ("(D)", "(G)") else "loss.beta"
    for label in ("(B)", "(C)", "(D)", "(E)", "(F)", "(G)", "(H)", "(I)")
}
OTHER_METHODS = {
    "CMX (MiT-B2)": (
        "model schedule trainer.max_steps transform | data.batch_size optimizer "
        "trainer.eval_every | optimizer.decay_biases optimizer.lr optimizer.weight_decay"
    ),
    "CMX (MiT-B4)": "| model.depths",
}
CMNEXT = f"model schedule transform | {SIZES}"
CMNEXT_RELEASED = f"trainer.selection_split {CMNEXT}"
OURS = {"Ours-con": "loss.second", "Ours-con-acc": "loss.second"}
RTFNET_152 = f"| {SIZES} model.depth schedule.epoch_steps"
TEACHERS = {"Thermal teacher": "model.modalities"}
HEATNETS = {
    "HeatNet (reproduced)": f"{NIGHT_LABELS} scheme.supervise_target scheme.weighed_by_confidence",
    "HeatNet RGB-only (reproduced)": f"{NIGHT_LABELS} model.modalities scheme trainer.max_steps",
}
FIRST_STAGES = {
    "SH, first stage with labels on IR": "domains.source.view domains.target scheme",
    "Multi-head, first stage": f"{TWO_HEADS} | {SIZES}",
}
OF_ONE_HEAD = "loss model.auxiliary model.weights scheme transform.blur_probability"
KEPT = {
    "Multi-head, first stage": (
        "domains.source.head domains.source.view domains.target domains.target_is model.heads "
        f"scheme | {SIZES}"
    ),
    "Multi-head, labels kept": "model.weights scheme | trainer.max_steps",
    "Multi-head, labels kept, no critic": "scheme",
}
ALONE = f"domains.target {ANOTHER_RECIPE} scheme | trainer.eval_every"
PARAMETERS = {
    "Multi-head network": f"{HEATNET} | data.batch_size trainer.eval_every",
    "Multi-head*, decoder as in the text": (
        f"{DECODER} model.weights | {SIZES} | model.base_width model.depths model.rates "
        "model.summed_rates"
    ),
    "Multi-head*, decoder of the unused file": "model.decoder model.dropout",
}

EXPECTED: dict[tuple[str, Form], dict[str, str]] = {
    ("temporal/table1", "paper"): {"(B)": "loss scheme", **LOSSES},
    ("temporal/table1", "released"): {"(B)": RELEASED_CMX, **LOSSES},
    ("temporal/table2", "paper"): {"(B)": "loss scheme", **MOTIONS},
    ("temporal/table2", "released"): {"(B)": RELEASED_CMX, **MOTIONS},
    ("temporal/table3", "paper"): WEIGHTS,
    ("temporal/table3", "released"): WEIGHTS,
    ("temporal/table4", "paper"): {
        **OTHER_METHODS,
        "CMNeXt": CMNEXT,
        "Ours-dice": f"loss optimizer.weight_decay scheme {CMNEXT}",
        **OURS,
    },
    ("temporal/table4", "released"): {
        **OTHER_METHODS,
        "CMNeXt": CMNEXT_RELEASED,
        "Ours-dice": f"loss scheme {CMNEXT_RELEASED}",
        **OURS,
    },
    ("temporal/table5", "paper"): {
        "Ours-con (ResNet-50)": "loss scheme",
        "RTFNet (ResNet-152)": f"loss scheme {RTFNET_152}",
        "Ours-con (ResNet-152)": "loss scheme",
    },
    ("temporal/table5", "released"): {
        "Ours-con (ResNet-50)": "loss scheme transform",
        "RTFNet (ResNet-152)": f"loss scheme transform {RTFNET_152}",
        "Ours-con (ResNet-152)": "loss scheme transform",
    },
    ("multihead/table1", "paper"): TEACHERS,
    ("multihead/table1", "released"): TEACHERS,
    ("multihead/table2", "paper"): HEATNETS,
    ("multihead/table2", "released"): HEATNETS,
    ("multihead/table3", "paper"): {
        "SH-Adv": f"{OF_ONE_HEAD} | {SIZES}",
        "SH-Adv(Seg. on IR)": "model.weights",
        "Multi-head": f"{TWO_HEADS} model.weights | {SIZES}",
        "Multi-head*": f"{DECODER} model.weights | model.dropout",
        "HeatNet*": f"{HEATNET} domains.target.split | data.batch_size trainer.eval_every",
        "RGB alone": ALONE,
        **FIRST_STAGES,
    },
    ("multihead/table3", "released"): {
        "SH-Adv": (
            f"{OF_ONE_HEAD} model.inputs.rgb_mean model.inputs.rgb_order model.inputs.rgb_std "
            "optimizer.head_rate prediction.align_corners prediction.enlarged prediction.mirrored "
            f"| {SIZES}"
        ),
        "SH-Adv(Seg. on IR)": "domains.target.labels scheme.supervise_target",
        "Multi-head": f"{TWO_HEADS} scheme.gradients | {SIZES}",
        "Multi-head*": (
            "domains.target.labels model.weights scheme.gradients scheme.supervise_target"
        ),
        "HeatNet*": (
            f"{HEATNET} domains.target.split scheme.critic.align_corners scheme.gradients "
            f"scheme.idle_steps prediction.align_corners {COUNTED} "
            "trainer.selection_split | data.batch_size trainer.eval_every"
        ),
        "RGB alone": f"{TESTED} {COUNTED} {ALONE}",
        **FIRST_STAGES,
    },
    ("multihead/table4", "paper"): {
        "Multi-head*": f"{DECODER} model.weights | {SIZES} model.dropout",
        "Multi-head**": f"model.weights | {SIZES}",
        "HeatNet RGB-only*": f"{STUDENT} | data.batch_size trainer.eval_every",
        "RGB by day alone": ALONE,
        **KEPT,
    },
    ("multihead/table4", "released"): {
        "Multi-head*": (
            "domains.target.labels domains.target.teacher_view model.weights "
            f"scheme.gradients scheme.supervise_target | {SIZES}"
        ),
        "Multi-head**": f"model.weights | {SIZES}",
        "HeatNet RGB-only*": (
            f"{STUDENT} domains.tested_head prediction.align_corners {COUNTED} "
            "| data.batch_size trainer.eval_every"
        ),
        "RGB by day alone": f"{TESTED} {COUNTED} {ALONE}",
        **KEPT,
    },
    ("multihead/table5", "paper"): PARAMETERS,
    ("multihead/table5", "released"): PARAMETERS,
}
"""Settings in which a row differs from the row above it that is run: at both scales | at
scale=paper too | at scale=demo too. A component that is replaced by another is one setting."""


@cache
def runs(name: str, form: Form, scale: str) -> Mapping[str, RunSpec]:
    """The run of every row of a table that can be run, by its label, in the order of the table."""
    table = TABLES[name]
    return {row.label: run_of(table, row, form, scale) for row in table.runnable_rows}


def run_of(table: Table, row: Row, form: Form, scale: str) -> RunSpec:
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return specified((*table.overrides(row, scale, form), f"scale={scale}", *rooted))


def upstream_names(run: RunSpec) -> set[str]:
    """Names of all upstream runs, those of upstream runs included."""
    return {each.name for each in run.upstream}.union(*map(upstream_names, run.upstream))


def settings_of(run: RunSpec) -> dict[str, Any]:
    flat = flatten(run.plain)
    return {key: value for key, value in flat.items() if key.split(".")[0] not in IGNORED}


def difference(one: RunSpec, other: RunSpec) -> set[str]:
    """Keys in which two runs differ; of a component of another class, its node alone."""
    first, second = settings_of(one), settings_of(other)
    keys = {key for key in {*first, *second} if first.get(key) != second.get(key)}
    replaced = sorted(key.removesuffix("._target_") for key in keys if key.endswith("._target_"))
    return {
        next((node for node in replaced if key == node or key.startswith(f"{node}.")), key)
        for key in keys
    }


QUICK = "temporal/table5"
"""The table that is composed in every form by the default suite; of the others, what is new."""

EVERY = [
    pytest.param(
        *(name, form, scale),
        marks=() if name == QUICK or (form, scale) == ("released", "demo") else pytest.mark.slow,
        id=f"{name} {form} {scale}",
    )
    for name in TABLES
    for form in FORMS
    for scale in SCALES
]


@pytest.mark.parametrize(("name", "form", "scale"), EVERY)
def test_row_differs_from_the_row_above_in_intended_settings(
    name: str, form: Form, scale: str
) -> None:
    found = runs(name, form, scale)
    labels = list(found)
    expected = EXPECTED[name, form]
    assert list(expected) == labels[1:]
    for above, label in zip(labels, labels[1:], strict=False):
        both, at_paper, at_demo, *_ = *expected[label].split("|"), "", ""
        wanted = f"{both} {at_paper if scale == 'paper' else at_demo}".split()
        assert difference(found[label], found[above]) == set(wanted), label


@pytest.mark.parametrize(("name", "form", "scale"), EVERY)
def test_rows_with_one_key_are_named_as_the_same(name: str, form: Form, scale: str) -> None:
    named = {row.label: row.same_as for row in TABLES[name].rows}
    first: dict[str, str] = {}
    for label, run in runs(name, form, scale).items():
        same = first.setdefault(run.key, label)
        assert same in (label, named[label]), label


@pytest.mark.slow
def test_rows_named_as_the_same_share_their_run_at_demo_scale() -> None:
    pairs = [
        (name, row.label, row.same_as)
        for name, table in TABLES.items()
        for row in table.rows
        if row.same_as is not None
    ]
    assert len(pairs) == 3
    for name, label, other in pairs:
        for form in FORMS:
            demo, paper = (runs(name, form, scale) for scale in SCALES)
            assert demo[label].key == demo[other].key
            assert paper[label].key != paper[other].key


@pytest.mark.slow
def test_released_rows_differ_from_those_of_the_paper() -> None:
    for name, table in TABLES.items():
        paper, released = (runs(name, form, "demo") for form in FORMS)
        for row in table.runnable_rows:
            is_same = paper[row.label].key == released[row.label].key
            assert is_same == (row.released is None), (name, row.label)


def test_upstream_runs_of_released_rows_are_released() -> None:
    """Earlier stages, and the teachers of pseudo-labels."""
    found = {
        f"{name} {label}": upstream_names(run)
        for name in ("multihead/table2", "multihead/table3", "multihead/table4")
        for label, run in runs(name, "released", "demo").items()
        if next(row for row in TABLES[name].rows if row.label == label).released is not None
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


STARRED = {
    # label: table, decoder, then per stage batch size and steps of 12,170 pairs: 50 and 100 epochs
    "Multi-head* thermal": ("multihead/table3", (16, 50 * 761), (16, 100 * 761)),
    "Multi-head* night": ("multihead/table4", (8, 50 * 1522), (8, 100 * 1522)),
    "Multi-head** night": ("multihead/table4", (16, 50 * 761), (16, 100 * 761)),
}


@pytest.mark.parametrize("row", STARRED)
def test_starred_rows_as_released_are_the_basic_network_in_two_stages(row: str) -> None:
    """The scripts import the basic network; the modified decoder is that of the paper's form."""
    name, *stages = STARRED[row]
    label = row.split()[0]
    (chosen,) = (each for each in TABLES[name].runnable_rows if each.label == label)
    found = {form: run_of(TABLES[name], chosen, form, "paper") for form in FORMS}
    assert found["paper"].model.plain["decoder"] == "modified_heatnet"
    second = found["released"]
    (first,) = (each.run for each in second.dependencies if each.key == "model.weights")
    for run, (batch_size, steps), gradients in zip(
        (first, second), stages, ("kept", "together"), strict=True
    ):
        assert run.model.plain["decoder"] == "basic"
        assert list(run.model.plain["heads"]) == ["source", "target"]
        assert list(run.model.plain["summed_rates"]) == [6, 12]
        assert (run.data.batch_size, run.trainer.max_steps) == (batch_size, steps)
        assert run.scheme.plain["gradients"] == gradients
    # The first stage is the same run where it is requested by its own name.
    alone = specified((f"+experiment={first.name}", "scale=paper", "dataset.root=/data"))
    assert alone.key == first.key


def test_parameters_of_the_starred_rows_in_both_forms() -> None:
    table = TABLES["multihead/table4"]
    row = next(each for each in table.rows if each.label == "Multi-head*")
    words = ("scale=paper", "dataset.root=/data")
    found = [million_parameters((*table.overrides(row, "paper", form), *words)) for form in FORMS]
    assert dict(zip(FORMS, found, strict=True)) == {"paper": 198.594658, "released": 44.564656}


NETWORKS = {
    row.network: name for name, table in TABLES.items() for row in table.rows if row.network
}
MILLIONS = {
    **{"model=cmx_b2": 66.57, "model=cmx_b4": 139.86, "model=rtfnet_50": 185.24},
    **{
        "model=cmnext_b4": 116.56,
        "model=rtfnet_152": 254.51,
        "model=heatnet": 54.36,
        "model=heatnet_rgb": 53.32,
    },
}
"""Parameters as the releases have them, with nine or 14 classes."""


@pytest.mark.parametrize("network", NETWORKS, ids=" ".join)
def test_network_for_weights_is_the_published_one(network: tuple[str, ...]) -> None:
    name = NETWORKS[network]
    words = ("scale=paper", *network, "dataset.root=/data")
    run = specify_run(words)
    assert run.dataset.plain["name"] == ("mfnet" if name.startswith("temporal") else "freiburg")
    (model,) = (word for word in network if word.startswith("model="))
    assert million_parameters(words) == pytest.approx(MILLIONS[model], abs=0.006)
    inputs = run.model.plain["inputs"]
    if "cmnext" in model:
        assert (inputs["rgb_order"], inputs["thermal_std"]) == ("rgb", [255.0] * 3)
    elif "cmx" in model:  # the public weights
        assert (inputs["rgb_order"], run.model.plain["decoder_norm_eps_eval"]) == ("bgr", 1e-5)
    else:
        assert inputs["rgb_mean"] == [0.0 if "rtfnet" in model else 127.5] * 3


def test_rows_of_several_networks_name_theirs_for_initial_weights() -> None:
    """weights.cmx_b2=FILE reaches the rows of that network at scale=paper."""
    found = {
        number: TableRequest("t", TABLES[f"temporal/table{number}"], "paper", (0,)).models()
        for number in (4, 5)
    }
    assert found == {
        4: {"cmx_b2", "cmx_b4", "cmnext_b4", "rtfnet_152"},
        5: {"rtfnet_50", "rtfnet_152"},
    }


@pytest.mark.parametrize("name", TABLES)
def test_table_has_claims_and_a_sentence_for_each_form(name: str) -> None:
    table = TABLES[name]
    assert set(table.forms) == set(FORMS)
    sentences = [*table.forms.values(), *(claim.says for claim in table.claims)]
    assert all(len(each.split()) <= 25 and each.endswith(".") for each in sentences)


CONTRADICTED = {
    "temporal/table1 views_raise_tc",
    "temporal/table1 con_acc_more_consistent_than_dice",
    "temporal/table1 dice_on_both_has_lowest_ca",
    "temporal/table1 proposed_variants_more_consistent_than_cmx",
    "temporal/table4 con_has_best_accuracy",
    "temporal/table5 resnet50_classes_improve",
}
NOT_PRINTED = {
    "temporal/table1 con_has_highest_aligned_consistency",
    "multihead/table5 modified_decoder_of_text_has_fewer_parameters",
    "multihead/table5 modified_decoder_of_unused_file_has_fewer_parameters",
}


def test_printed_values_agree_with_all_claims_but_the_known_ones() -> None:
    contradicted, without = set(), set()
    for name, table in TABLES.items():
        values = {row.label: row.values for row in table.rows}
        for claim in table.claims:
            low, high = claim.range
            sizes = []
            for column in claim.columns:
                for row, other in claim.pairs(list(values)):
                    signs = [(row, 1), *([(other, -1)] if other is not None else [])]
                    terms = [
                        sign * side * value
                        if (value := values[label].get(each)) is not None
                        else None
                        for label, sign in signs
                        for each, side in ((column, 1), (claim.minus_column, -1))
                        if each is not None
                    ]
                    if None not in terms:
                        sizes.append(round(sum(term for term in terms if term is not None), 3))
            if not sizes:
                without.add(f"{name} {claim.name}")
            elif not all(low < size < high for size in sizes):
                contradicted.add(f"{name} {claim.name}")
    assert (contradicted, without) == (CONTRADICTED, NOT_PRINTED)
