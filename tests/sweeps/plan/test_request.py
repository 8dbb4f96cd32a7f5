from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import available, compose
from sweeps.plan.claim import Claim
from sweeps.plan.planner import Planner
from sweeps.plan.request import (
    ExternalRow,
    TableRequest,
    check_equal_runs,
    external_rows,
    make_request,
    seeds_of,
    select_rows,
)
from sweeps.plan.table import Column, Row, load_table
from sweeps.point import Outcome
from tests.sweeps.tabled import table

COLUMNS = (
    Column(name="mIoU", metric="mIoU"),
    Column(name="night", metric="mIoU", modality="thermal"),
    Column(name="cold", metric="Var", modality="thermal"),
    Column(name="less", minus=("night", "mIoU")),
)
ROWS = (
    Row(label="small", experiment="crm", at={"paper": ("model=mask2former_swin_s",)}),
    Row(label="large", experiment="crm", at={"paper": ("model=mask2former_swin_b",)}),
    Row(label="other", experiment="grbm", overrides=("masker.sigma_div=2",)),
    Row(label="theirs", values={"mIoU": 3.0}),
)


def wanted(scale: str = "demo", **others: object) -> TableRequest:
    at = {"paper": ("recipe.batch_size=5",)}
    return TableRequest("own/t", table(ROWS, COLUMNS, at=at, **others), scale, (0, 2), ("a.b=1",))


def test_points_share_runs_of_equal_rows() -> None:
    points = wanted().points()
    assert [point.label for point in points] == [
        "small (and 1 more) seed=0",
        "other seed=0",
        "small (and 1 more) seed=2",
        "other seed=2",
    ]
    assert points[0].overrides == ("+experiment=crm", "a.b=1", "seed=0")
    assert points[1].overrides == ("+experiment=grbm", "masker.sigma_div=2", "a.b=1", "seed=0")
    assert points[0].tags == {
        "rgbt.table/own/t": "small | large",
        "rgbt.requested/own/t": "paper '' a.b=1",
    }
    machine = replace(wanted(), extra=("dataset.root=/x", "a.b=1", "fresh=true"))
    assert machine.tags(["small", "large"]) == points[0].tags
    assert replace(wanted(), extra=(), form="released").tags(["small"]) == {
        "rgbt.table/own/t": "small",
        "rgbt.requested/own/t": "released ''",
    }
    assert points[0].seeds == ()
    assert points[0].evaluations == (("modality=thermal",),)


def test_frames_are_evaluated_whatever_the_regions_of_the_table() -> None:
    columns = (
        *(Column(name="mIoU", metric="mIoU"), Column(name="TC", metric="TC", frames="released")),
        Column(name="TC aligned", metric="TC", frames="aligned", printed=False),
    )
    for regions, others in (("as trained", ()), ("ring9", (("regions=ring9",),))):
        asked = TableRequest("own/t", table(ROWS, columns, regions=regions), "demo", (0,))
        assert asked.points()[0].evaluations == (
            *others,
            ("frames=released",),
            ("frames=aligned",),
        )


def test_outcomes_go_back_to_their_cells() -> None:
    asked = wanted()
    outcomes = [Outcome(point, "failed", point.label) for point in asked.points()]
    first = {"small": "small (and 1 more)", "large": "small (and 1 more)", "other": "other"}
    assert {place: run.reason for place, run in asked.runs(outcomes).items()} == {
        (row, seed): f"{label} seed={seed}" for seed in (0, 2) for row, label in first.items()
    }


def test_seeds_are_a_number_or_a_list() -> None:
    for text, seeds in {"3": (0, 1, 2), "1": (0,), "4,7": (4, 7), "[5,0]": (5, 0)}.items():
        assert seeds_of(text) == seeds
    for text in ("0", "", "a", "1,1", "-2", "1.5", "1,"):
        with pytest.raises(InputError, match="^seeds="):
            seeds_of(text)


def test_rows_of_different_networks_start_from_separate_files() -> None:
    given = (
        *("pretrained.mask2former_swin_t=/w/t=1.pth", "pretrained.mask2former_swin_b=b.pth"),
        "x=1",
    )
    wanted = make_request("spatialseg/table7", "paper", words=given)
    assert wanted.external == ()
    assert wanted.overrides("Ours (Swin-T)", 0)[-3:] == (
        *("x=1", "model.weights='/w/t=1.pth'", "seed=0"),
    )
    assert "model.weights=b.pth" in wanted.overrides("Ours (Swin-B)", 0)
    assert not [word for word in wanted.overrides("Ours (Swin-S)", 0) if "weights" in word]
    assert wanted.typed_overrides() == ("x=1", *given[:2])
    with pytest.raises(InputError, match="did you mean 'mask2former_swin_b'"):
        make_request("spatialseg/table7", "paper", words=["pretrained.mask2former_swinb=x"])


def test_form_and_rows_make_another_table() -> None:
    chosen = (("paper", ""), ("paper", "Ny/4,Ny/8"), ("released", ""))
    made = [
        make_request("spatialseg/table3", "demo", form=form, rows=rows) for form, rows in chosen
    ]
    variants = [request.variant for request in made]
    assert variants[0] == "demo"
    assert variants[1].startswith("demo-")
    assert variants[2] == "demo-released"
    assert [len(request.points()) for request in made] == [7, 2, 7]
    assert made[0].overrides("Ny/4", 0)[0] == "+experiment=grbm"
    assert made[2].overrides("Ny/4", 0)[0] == "+experiment=grbm_released"


def test_both_forms_are_compared_by_claims() -> None:
    request = make_request("spatialseg/table3", "demo", form="both", rows="Ny/4,Ny/8")
    labels = ["Ny/4", "Ny/4, released", "Ny/8", "Ny/8, released"]
    assert [row.label for row in request.table.rows] == labels
    words_of = [request.overrides(label, 0)[0] for label in labels[:2]]
    assert words_of == ["+experiment=grbm", "+experiment=grbm_released"]
    claims = request.table.claims
    assert [(c.rows, c.against, c.columns) for c in claims[:2]] == [
        (("Ny/4, released",), ("Ny/4",), (column,)) for column in ("mIoU", "Var")
    ]
    assert len(claims) == 4


@pytest.mark.parametrize("scale", available("scale"))
def test_every_seed_of_a_table_has_a_start_of_its_own(scale: str) -> None:
    """A verdict about one start would not be general."""
    request = TableRequest("t", load_table("spatialseg/table3"), scale, (0,))
    config = compose(request.overrides("Ny/4", 0))
    is_common = str(config.pretrained).startswith("common:")
    assert is_common == (scale == "bench")
    assert not is_common or config.seeds.start == "run"


def claim(name: str, rows: tuple[str, ...], against: tuple[str, ...]) -> Claim:
    about: Any = {"says": "", "source": "", "columns": ("acc",), "expected": "higher"}
    return Claim(name=name, rows=rows, against=against, **about)


def test_selected_rows_keep_their_claims() -> None:
    rows = (
        Row(label="a", experiment="crm"),
        Row(label="b", experiment="crm", same_as="a"),
        Row(label="c", experiment="grbm"),
    )
    claims = (claim("b_a", ("b",), ("a",)), claim("c_a", ("c",), ("a",)))
    made = table(rows, claims=(*claims, claim("best", ("c",), ("others",))))
    chosen = select_rows(made, "c,1")
    assert [row.label for row in chosen.rows] == ["a", "c"]
    assert [claim.name for claim in chosen.claims] == ["c_a"]
    assert select_rows(made, "a,b,c").claims == made.claims
    with pytest.raises(InputError, match="'e'"):
        select_rows(made, "e")


def test_undeclared_rows_of_one_run_are_refused() -> None:
    first, third, fourth = (Row(label=label, experiment="baseline") for label in ("a", "c", "d, e"))
    same = Row(label="b", experiment="baseline", same_as="a")
    request = TableRequest("own/t", table((first, third)), "demo")
    with pytest.raises(InputError, match=r"'a' and 'c' of own/t would be the same run .* same_as"):
        check_equal_runs(request, Planner())
    declared = table((first, same, replace(third, same_as="b"), fourth))
    # Twins of a row that is left out stay declared.
    for rows in ("a,b,c", "b,c", "a,c"):
        check_equal_runs(replace(request, table=select_rows(declared, rows)), Planner())
    with pytest.raises(InputError, match="'b' and 'd, e'"):
        check_equal_runs(replace(request, table=select_rows(declared, "b,c,4")), Planner())


NAMED = table(
    (
        *(Row(label="CMNeXt"), Row(label="MFNet", experiment="mfnet")),
        Row(label="RTFNet", network=("model=rtfnet_tiny",)),
        *(Row(label="sigma"), Row(label="sigma=H/4"), Row(label="2")),
    )
)


@pytest.mark.parametrize(
    ("name", "label"),
    [("CMNeXt", "CMNeXt"), ("sigma=H/4", "sigma=H/4"), ("3", "RTFNet"), ("2", "2")],
)
def test_external_row_is_named_by_label_or_number(tmp_path: Path, name: str, label: str) -> None:
    folder = tmp_path / "a=b"
    folder.mkdir()
    words = [f"predictions.{name}={folder}", "dataset=mfnet"]
    assert external_rows(words, NAMED) == (
        [ExternalRow(label, "predictions", folder)],
        ["dataset=mfnet"],
    )


@pytest.mark.parametrize(
    "word",
    [
        *("predictions.cmnext={folder}", "predictions.9={folder}", "weights.MFNet={folder}"),
        *("predictions.MFNet={folder}/x.png", "predictions.MFNet=", "weights.CMNeXt={folder}/w"),
    ],
)
def test_wrong_external_word_is_refused(tmp_path: Path, word: str) -> None:
    (tmp_path / "w").touch()
    with pytest.raises(InputError, match="row|ROW"):
        external_rows([word.format(folder=tmp_path)], NAMED)


def test_seeds_are_folds_of_a_scale() -> None:
    given = replace(load_table("crm/table3a"), folds={"real": "mfnet200"}, blocks={"real": 10})
    request = TableRequest("crm/table3a", given, "real")
    folds = [f"dataset=mfnet200_fold{number}" for number in range(4)]
    words = [request.overrides("Ours", seed) for seed in (0, 1, 2, 3, 4, 13)]
    assert [next(w for w in of if w.startswith("dataset=")) for of in words] == [
        *folds,
        folds[0],
        folds[1],
    ]
    assert words[0][-1] == "seed=0"
    plain = replace(request, scale="bench").overrides("Ours", 1)
    assert not any(word.startswith("dataset=") for word in plain)
