"""A table at smoke size whose finished runs hold planted outcomes: true, false, undecidable."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import pytest

from rgbt.files.plain_files import write_json
from sweeps.claims import entry as claims
from sweeps.plan.planner import Planner
from sweeps.reproduce import entry as reproduce
from tests.commands import Call, assert_one_sentence
from tests.measured import remeasured
from tests.sweeps.judge.accuracies import accuracy

TABLE = """\
paper: my
number: planted
caption: outcomes that are known
data: nothing
confirm: [0, 1, 2]
columns:
  - {name: acc, metric: pixel_accuracy}
claims:
  - {name: true_one, says: High is above low., source: Sec. I, rows: [high], against: [low],
     columns: [acc], expected: higher}
  - {name: false_one, says: Low is above same., source: Sec. II, rows: [low], against: [same],
     columns: [acc], expected: higher}
  - {name: small_one, says: Same is above high., source: Sec. III, rows: [same], against: [high],
     columns: [acc], expected: higher}
  - {name: absent_one, says: Theirs is below low., source: Sec. IV, rows: [theirs], against: [low],
     columns: [acc], expected: lower}
rows:
  - {label: low, experiment: baseline, values: {acc: 50.0}}
  - {label: high, experiment: baseline, overrides: [masker=crm], values: {acc: 60.0}}
  - {label: same, experiment: baseline, overrides: [masker=irm], values: {acc: 61.0}}
  - {label: theirs, values: {acc: 40.0}}
"""
SHARES = {"masker=none": (50, 51, 49), "masker=crm": (60, 61, 59), "masker=irm": (60, 60, 60)}
SMOKE = "+debug=smoke"


def plant(runs_dir: Path, tags: dict[str, str] | None = None) -> None:
    """Finished runs of every row with seeds 0 to 2."""
    planner = Planner((f"runs_dir={runs_dir}",))
    for masker, shares in SHARES.items():
        row = () if masker == "masker=none" else (masker,)
        for seed, share in enumerate(shares):
            words = ("+experiment=baseline", *row, SMOKE, f"seed={seed}")
            run = planner.specify((f"runs_dir={runs_dir}", *words))
            dataset = planner.fingerprint(run)
            folder = runs_dir / run.key
            folder.mkdir(parents=True)
            own = {"rgbt.experiment": "baseline", "rgbt.seed": str(seed), **(tags or {})}
            described = {"name": run.key, "tags": own, "params": {}}
            write_json(folder / "run.json", described)
            remeasured(accuracy(share, seed), dataset=dataset).save(folder / "counts_test.npz")
            result = {"key": run.key, "dataset": dataset, "test": {"mIoU": share / 100}}
            write_json(folder / "result.json", result)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tables" / "my").mkdir(parents=True)
    (tmp_path / "tables" / "my" / "planted.yaml").write_text(TABLE)
    return tmp_path


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


WORDS = ["same direction", "opposite direction", "not shown", "not run"]
COUNTED = "4 claims: 1 same direction, 1 opposite direction, 1 not shown, 1 not run; 3 by declared"


def test_reproduce_ends_with_a_verdict_per_claim(call: Call, place: Path) -> None:
    plant(place / "runs")
    words = ("table=my/planted", "seeds=3", "tracking=none", "out=here", SMOKE)
    code, out, _ = call(reproduce, *words)
    assert code == 0
    assert COUNTED in " ".join(out.split())
    found = rows_of(place / "here" / "claims.csv")
    assert [row["verdict"] for row in found] == WORDS
    assert [row["as_printed"] for row in found] == ["True", "False", "True", "True"]
    assert found[3]["missing"] == "theirs"
    text = (place / "here" / "table.md").read_text()
    assert "- `true_one`: High is above low. **Same direction** on unknown images: +" in text
    assert "high - low, acc; unknown images, scale=unknown, a start for each seed." in text
    marked = [line for line in text.splitlines() if "**" in line and line.startswith("| ")]
    assert not marked, "high and same cannot be told apart, so that no row is the best"


def test_claims_reads_the_store(call: Call, place: Path) -> None:
    plant(place / "runs")
    code, out, err = call(claims, "table=my/planted", "out=there", SMOKE)
    assert code == 0, err
    assert COUNTED in " ".join(out.split())
    assert [line.split() for line in out.splitlines() if " my " in line][-1][-3:] == [
        *"3",
        "of",
        "4",
    ]
    assert [row["verdict"] for row in rows_of(place / "there" / "claims.csv")] == WORDS
    assert "(Sec. III)" in (place / "there" / "claims.md").read_text()
    code, out, _ = call(claims, "table=my/planted,crm/table4")
    assert (code, "6 claims: 6 not run; 0 by" in out) == (0, True), "at full size nothing was run"


def test_seeds_that_are_not_declared_explore(call: Call, place: Path) -> None:
    plant(place / "runs")
    own = place / "tables" / "my" / "planted.yaml"
    own.write_text(TABLE.replace("confirm: [0, 1, 2]\n", ""))
    _, out, _ = call(claims, "table=my/planted", SMOKE)
    assert "4 claims: 3 not shown, 1 not run; 0 by declared seeds." in " ".join(out.split())
    assert call(reproduce, "table=my/planted", "seeds=confirm", "dry_run=true", SMOKE)[0] == 2


def test_claims_say_how_far_runs_rank_like_print(call: Call, place: Path) -> None:
    plant(place / "runs")
    _, out, _ = call(claims, "table=my/planted", SMOKE)
    said = " ".join(out.split())
    assert "Of 3 claims judged at 5 %, chance alone would show up to 0.1 in the claimed" in said
    assert "On unknown images at scale=unknown, 3 of 3 contrasts have the printed sign" in said


def test_dry_run_until_decided_shows_the_next_runs(call: Call, place: Path) -> None:
    plant(place / "runs")
    words = ("table=my/planted", "seeds=until_decided", "max_seeds=5", "tracking=none", SMOKE)
    code, out, _ = call(reproduce, *words, "dry_run=true")
    assert code == 0
    assert "12 runs: 9 finished, 3 waiting." in out


@pytest.mark.parametrize(
    ("command", "word", "key"),
    [
        (reproduce, "seeds=until_decided rows=low", "seeds=until_decided"),
        (reproduce, "form=both", "form=both"),
        (reproduce, "rows=lowest", "'lowest'"),
        (reproduce, "masker=none", "would be the same run"),
        (claims, "weights.low=file.pth", "weights.low"),
        (claims, "seed=3", "'seed=3'"),
    ],
)
def test_words_that_do_not_fit_are_refused(
    call: Call, place: Path, command: Callable[[], None], word: str, key: str
) -> None:
    (place / "runs").mkdir()
    (place / "file.pth").touch()
    code, _, err = call(command, "table=my/planted", *word.split())
    assert code == 2
    assert_one_sentence(err, key)
