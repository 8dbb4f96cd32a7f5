"""Parts of the page's data that need no store: commands, fronts, choices, masks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.report import masks, tables
from analysis.report.data import RunEntry
from analysis.report.differences import Choice, Side, find_pairs, load_choices
from analysis.report.masks import data_address, mask_pictures, maskers_in_use
from analysis.report.runs import ReportRun
from analysis.report.runs_provenance import read_provenance, repeat_command
from analysis.report.store import MlflowRun, RunFiles
from analysis.report.studies import pareto_front, read_study
from analysis.report.tables_recorded import CSV_FILE, read_recorded, reproduce_command
from rgbt.checks import InputError
from rgbt.config.compose import compose, flatten
from rgbt.metrics.counts import Counts
from sweeps.table.load_table import load_table
from tests.analysis.report.stores import DATASET, MASKER, counts_of, files_of


def stored(files: RunFiles, **tags: str) -> MlflowRun:
    return MlflowRun(
        run_id="id",
        name="made",
        status="FINISHED",
        started="",
        seconds=None,
        tags={name.replace("__", "."): value for name, value in tags.items()},
        params={},
        metrics={},
        files=files,
    )


def run_of(config: dict[str, Any], seed: int = 0, counts: Counts | None = None) -> ReportRun:
    """A run with that configuration, by dotted key."""
    texts = ("name", "run_id", "commit", "started", "command", "repeat", "host", "dataset")
    entry = RunEntry(
        key=f"k{seed}",
        status="FINISHED",
        experiment="grbm",
        scale="demo",
        seed=seed,
        group=str(config.get("group", "grbm")),
        studies=(),
        table_rows={},
        scores={},
        seconds=None,
        config={},
        **dict.fromkeys(texts, ""),
    )
    return ReportRun(
        entry=entry,
        test_counts=counts or counts_of(seed),
        absent="released",
        config={"seed": seed, **config},
        files=RunFiles(()),
    )


GRID = {"rgbt.group": "grbm model=mask2former_tiny lr=0.1", "rgbt.experiment": "grbm"}


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (
            "/venv/bin/python -m rgbt.run scale=demo runs_dir=/tmp/t3 +experiment=crm seed=2",
            "python -m rgbt.run scale=demo +experiment=crm seed=2",
        ),
        (
            "python -m rgbt.run +experiment=crm tracking=none tracking.uri=http://h:1 out=x "
            "hydra/sweeper=basic hydra.sweeper.workers=2",
            "python -m rgbt.run +experiment=crm",
        ),
        (
            "python -m rgbt.run -m +experiment=crm,grbm masker.sigma_div=1,2 seed='range(0,3)' "
            "model=a,mask2former_tiny optimizer.lr=0.1,0.2",
            "python -m rgbt.run +experiment=grbm masker.sigma_div=2.0 seed=1 "
            "model=mask2former_tiny optimizer.lr=0.1",
        ),
        (
            "python -m rgbt.run 'model.rates=[1,2]' 'name=\"a, b\"'",
            "python -m rgbt.run 'model.rates=[1,2]' 'name=\"a, b\"'",
        ),
        ("python -m pytest tests", ""),
        ("python -m rgbt.run 'cut", ""),
        ("", ""),
    ],
)
def test_a_run_is_repeated_with_its_own_overrides(command: str, expected: str) -> None:
    config = {"seed": 1, "masker.sigma_div": 2.0}
    assert repeat_command(command, config, GRID) == expected


def test_run_continued_by_other_code_is_reported(tmp_path: Path) -> None:
    remarks: list[str] = []
    text = '[{"git_commit": "aaa"}, {"git_commit": "bbb", "git_dirty": true}]'
    processes = read_provenance(files_of(tmp_path, provenance__json=text), "k", remarks)
    assert len(processes) == 2
    assert remarks == ["Run k was started and continued by different code: aaa, then bbb+."]


@pytest.mark.parametrize("text", ["{", "{}"])
def test_damaged_provenance_is_reported(tmp_path: Path, text: str) -> None:
    remarks: list[str] = []
    assert read_provenance(files_of(tmp_path, provenance__json=text), "k", remarks) == []
    assert "provenance.json cannot be read" in remarks[0]


def test_front_contains_points_that_no_other_dominates() -> None:
    values = [(1.0, 5.0), (2.0, 6.0), (1.5, 7.0), (), (math.nan, 0.0), (2.0, 6.0)]
    assert pareto_front(values, (True, False)) == {0, 1, 5}
    assert pareto_front(values, (True, True)) == {1, 2, 5}
    assert pareto_front([(1.0,), (3.0,), (3.0,)], (True,)) == {1, 2}
    assert pareto_front([(1.0,), (3.0,)], (False,)) == {0}


MARKDOWN = "# Study s\n\nKind: grid. Objectives: highest test/mIoU.\n"
TRIALS = (
    "trial,state,label,test/mIoU,seconds,last_step,runs,reason\n0,complete,a=1,5.5,1,2,k1 k2,\n"
)


def test_a_point_without_parameters_is_called_by_its_label(tmp_path: Path) -> None:
    files = files_of(tmp_path, study__md=MARKDOWN, trials__csv=TRIALS)
    study = read_study(stored(files, rgbt__study="s", rgbt__study__kind="grid"))
    (trial,) = study.trials
    assert (trial.params, trial.values, trial.runs) == ({"point": "a=1"}, (5.5,), ("k1", "k2"))
    assert study.command == ""


HEADER = "table,row,column,mean,sd,n,published,difference,reason,runs\n"


@pytest.mark.parametrize(
    ("read", "texts", "sentence"),
    [
        (read_study, {}, "does not name the objectives"),
        (read_study, {"study__md": MARKDOWN}, "has no trials.csv"),
        (read_study, {"study__md": MARKDOWN, "trials__csv": "trial,state\n"}, "the column 'label'"),
        (
            read_study,
            {"study__md": MARKDOWN, "trials__csv": TRIALS.replace("5.5", "high")},
            "is damaged",
        ),
        (
            read_study,
            {"study__md": MARKDOWN, "trials__csv": TRIALS.splitlines()[0] + "\n0,complete\n"},
            "is damaged",
        ),
        (read_recorded, {}, "has no table.csv in the store"),
        (read_recorded, {"table__csv": "table,row\n"}, "lacks the column 'column'"),
        (read_recorded, {"table__csv": HEADER + "t,A,x,high,,1,,,,k\n"}, "is damaged"),
        (read_recorded, {"table__csv": HEADER + "t,A,x\n"}, "is damaged"),
    ],
)
def test_damaged_record_is_one_sentence(
    tmp_path: Path, read: Any, texts: dict[str, str], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        read(stored(files_of(tmp_path, **texts), rgbt__study="s"))


RECORD_MD = """**own, TABLE I: Two masks**

| | mIoU |
| --- | ---: |
| A | 1.0 |

1. A footnote.

- Published: somewhere; percent.
- Form: as the text describes it.
- Bold: shown to be the best of our rows.

**Claims**

| claim | verdict |
| --- | ---: |
| better | undecided |

- difference: mean over paired seeds.

- `better`, **undecided**: B is better (Sec. 1). The printed values agree.
    - A reading of ours.
"""


def test_read_recorded_lines_of_claims_are_no_remarks(tmp_path: Path) -> None:
    csv = HEADER + "own/t,A,mIoU,50.0,,1,61.5,,,aa0\n"
    files = files_of(tmp_path, table__csv=csv, table__md=RECORD_MD)
    assert read_recorded(stored(files)).remarks == ("Form: as the text describes it.",)


def test_read_recorded_table_without_remarks_takes_none_of_its_claims(tmp_path: Path) -> None:
    csv = HEADER + "own/t,A,mIoU,50.0,,1,61.5,,,aa0\n"
    text = RECORD_MD[: RECORD_MD.index("1. A")] + RECORD_MD[RECORD_MD.index("**Claims") :]
    assert read_recorded(stored(files_of(tmp_path, table__csv=csv, table__md=text))).remarks == ()


@pytest.mark.parametrize(
    ("tags", "label", "form"),
    [
        ({}, "B", "paper"),
        ({"rgbt__form": "paper"}, "B", "paper"),
        ({"rgbt__form": "released"}, "B", "released"),
        ({"rgbt__form": "paper"}, "A, released", "both"),
    ],
)
def test_read_recorded_form_is_that_of_the_rows(
    tmp_path: Path, tags: dict[str, str], label: str, form: str
) -> None:
    csv = HEADER + f'own/t,A,mIoU,50.0,,1,61.5,,,aa0\nown/t,"{label}",mIoU,50.0,,1,,,,bb0\n'
    assert read_recorded(stored(files_of(tmp_path, table__csv=csv), **tags)).form == form


def test_reproduce_command_names_form_and_rule() -> None:
    command = reproduce_command("own/t", (0, 1), "demo", form="both", until_decided=True)
    assert command == "rgbt reproduce table=own/t seeds=until_decided scale=demo form=both"


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        ((0, 1, 2), "seeds=3"),
        ((0,), "seeds=1"),
        ((0, 4), "seeds=0,4"),
        ((4,), "'seeds=[4]'"),
    ],
)
def test_a_table_is_run_with_its_seeds(seeds: tuple[int, ...], words: str) -> None:
    assert reproduce_command("own/t", seeds, "demo") == (
        f"rgbt reproduce table=own/t {words} scale=demo"
    )


def composed(choice: Choice, side: Side) -> dict[str, Any]:
    assert side.setting is not None
    return flatten(compose([*choice.base, side.setting]))


@pytest.mark.parametrize("choice", load_choices(), ids=lambda choice: choice.topic)
def test_choices_differ_only_in_their_keys(choice: Choice) -> None:
    paper = composed(choice, choice.paper)
    assert {key: paper[key] for key in choice.paper.values} == choice.paper.values
    if choice.released.setting is None:
        return
    released = composed(choice, choice.released)
    apart = {key for key in {*paper, *released} if paper.get(key) != released.get(key)}
    assert apart == choice.paper.values.keys() == choice.released.values.keys()
    assert {key: released[key] for key in apart} == choice.released.values


CHOICE = Choice("t", "s", (), Side("a.x=1", {"a.x": 1}, ""), Side("a.x=2", {"a.x": 2}, ""))


def test_pairs_differ_only_in_the_choice() -> None:
    same = {"model.width": 4, "tracking.uri": "here", "dataset.root": "/a"}
    elsewhere = {"model.width": 4.0, "tracking.uri": "there", "dataset.root": "/b"}
    paper = [run_of({"a.x": 1, **same}, seed) for seed in (1, 0)]
    released = [run_of({"a.x": 2, **elsewhere}, seed) for seed in (0, 1)]
    other = run_of({"a.x": 2, "model.width": 5})
    neither = run_of({"a.x": 3, **same})
    (pair,) = find_pairs(CHOICE, [*paper, *released, other, neither])
    assert pair.paper == (paper[1], paper[0])
    assert pair.released == tuple(released)
    assert find_pairs(CHOICE, [*paper, other]) == []


def test_runs_on_other_images_are_no_pair() -> None:
    from dataclasses import replace

    elsewhere = replace(counts_of(0), dataset="others")
    runs = [run_of({"a.x": 1}), run_of({"a.x": 2}, counts=elsewhere)]
    assert find_pairs(CHOICE, runs) == []


def masked_config(**changed: Any) -> dict[str, Any]:
    masker = {**MASKER, **changed}
    nodes = {"masker": masker, "dataset": DATASET}
    return {f"{node}.{key}": v for node, values in nodes.items() for key, v in values.items()}


def quiet(items: Any, what: str) -> Any:
    return items


def test_maskers_are_distinguished_by_their_settings() -> None:
    runs = [
        run_of({**masked_config(), "group": "one"}, 0),
        run_of({**masked_config(sigma_div=2.0), "group": "two"}, 0),
        run_of({**masked_config(sigma_div=2.0), "group": "two"}, 1),
        run_of({**masked_config(sampler="none"), "group": "plain"}),
        run_of({"group": "unknown"}),
    ]
    found = maskers_in_use(runs)
    assert [(each.groups, each.runs) for each in found] == [(("two",), 2), (("one",), 1)]
    assert found[0].masker["sigma_div"] == 2.0


def test_masks_of_missing_data_use_embedded_images() -> None:
    config = masked_config()
    away = {"dataset._target_": "rgbt.data.mfnet.MFNet", "dataset.root": "/nowhere"}
    gone = {key: v for key, v in config.items() if not key.startswith("dataset.")} | away
    remarks: list[str] = []
    (picture,) = mask_pictures([run_of(gone)], quiet, remarks)
    assert "of the embedded data set" in picture.caption
    assert remarks == []


@pytest.mark.parametrize("group", ["masker", "dataset"])
def test_a_hostile_artifact_is_a_remark_and_runs_nothing(group: str, tmp_path: Path) -> None:
    evil = {"_target_": "os.system", "command": f"touch {tmp_path / 'marker'}"}
    others = {k: v for k, v in masked_config().items() if not k.startswith(f"{group}.")}
    config = others | {f"{group}.{key}": value for key, value in evil.items()}
    remarks: list[str] = []
    runs = [run_of({**config, "group": "evil"}), run_of(masked_config())]
    (picture,) = mask_pictures(runs, quiet, remarks)
    assert picture.title == ("grbm" if group == "masker" else "evil")
    assert ("embedded" in picture.caption) == (group == "dataset")
    (remark,) = remarks
    assert f"its config.yaml: '{group}._target_' names os.system, which no file of" in remark
    assert not (tmp_path / "marker").exists()


def test_own_masker_is_drawn_where_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_maskers.py").write_text(
        "from rgbt.maskers.masker import Masker\n\nclass Mine(Masker):\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    runs = [run_of(masked_config(_target_="my_maskers.Mine"))]
    remarks: list[str] = []
    assert mask_pictures(runs, quiet, remarks) == ()
    assert "add trust=my_maskers" in remarks[0]
    assert len(mask_pictures(runs, quiet, remarks, trust=("my_maskers",))) == 1


def test_masker_that_cannot_be_built_is_reported() -> None:
    remarks: list[str] = []
    runs = [run_of(masked_config(sampler="guess"))]
    assert mask_pictures(runs, quiet, remarks) == ()
    assert remarks[0].startswith("Masks of 'grbm' cannot be drawn: ")


def test_more_maskers_than_fit_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(masks, "MOST", 1)
    remarks: list[str] = []
    runs = [run_of(masked_config(sigma_div=float(div))) for div in (1, 2, 4)]
    assert len(mask_pictures(runs, quiet, remarks)) == 1
    assert remarks == ["Masks of 1 maskers are shown; 2 more were used."]


def test_pictures_stay_small_whatever_they_show() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (320, 640, 3), dtype=np.uint8)
    assert len(data_address(noise)) <= 4 * masks.MOST_BYTES / 3 + 30
    assert data_address(np.zeros((8, 8, 3), np.uint8)).startswith("data:image/webp;base64,")


@pytest.mark.parametrize("name", ["spatialseg/table3", "gone/t"])
def test_overrides_of_a_table_are_shown_beside_its_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "table_names", lambda: ["spatialseg/table3"])
    said = {
        "plain": "- A remark.\n",
        "short": "- Every row of ours was run with trainer.max_steps=9 loss.spatial.alpha=1.\n",
    }
    labels = [row.label for row in load_table("spatialseg/table3").rows]
    every = "".join(f"{name},{label},mIoU,50.0,,1,61.5,,,aa0\n" for label in labels)
    records = [
        MlflowRun(
            run_id=variant,
            name=f"{name} demo",
            status="FINISHED",
            started="",
            seconds=None,
            tags={"rgbt.table": name, "rgbt.scale": "demo", "rgbt.seeds": "0"},
            params={},
            metrics={},
            files=files_of(tmp_path / variant, **{CSV_FILE: csv, "table.md": text}),
        )
        for variant, text in said.items()
        for csv in [HEADER + every]
    ]
    remarks: list[str] = []
    made = tables.table_entries(records, {}, 100, quiet, remarks)
    extras = [each.extra for each in made if each.name == name]
    assert extras == ["", "trainer.max_steps=9 loss.spatial.alpha=1"]


def test_selected_rows_of_a_table_are_shown_beside_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "table_names", lambda: ["spatialseg/table3"])
    name = "spatialseg/table3"
    csv = HEADER + "".join(f"{name},{label},mIoU,50,,1,,,,a\n" for label in ("CRM baseline", "Ny"))
    files = files_of(tmp_path, **{"table__csv": csv})
    record = stored(files, rgbt__table=name, rgbt__scale="demo", rgbt__seeds="0")
    made = tables.table_entries([record], {}, 100, quiet, [])[0]
    assert made.extra == "'rows=CRM baseline,Ny'"
    assert made.command.endswith("scale=demo 'rows=CRM baseline,Ny'")
