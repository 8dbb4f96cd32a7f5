"""Words that name external rows, and the overrides that carry the table's data set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from rgbt.checks import InputError
from rgbt.config.compose import compose
from sweeps.table.cells import evaluation_of
from sweeps.table.external import ExternalRow, external_rows
from sweeps.table.external_data import as_typed, data_of
from sweeps.table.external_evaluations import content_hash
from sweeps.table.load_table import load_table
from sweeps.table.table import Column, Row, Table

COLUMN = Column(name="mIoU", metric="mIoU")


def table_of(*labels: str, **common: Any) -> Table:
    rows = tuple(Row(label=label, **common) for label in labels)
    return Table(paper="p", number="1", caption="c", data="d", columns=(COLUMN,), rows=rows)


TABLE = table_of(
    *("(A)", "(B)", "CMX (MiT-B2)", "RTFNet (ResNet-50)", "RTFNet (ResNet-152)", "sigma=H/4"),
    *("Ours", "Ours (Swin-S), MFNet"),
    network=("model=mfnet",),
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "predicted").mkdir()
    (tmp_path / "a=b.pth").write_bytes(b"weights")
    return tmp_path / "predicted"


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("(A)", "(A)"),
        ("a", "(A)"),
        ("CMX", "CMX (MiT-B2)"),
        ("cmx (mit-b2)", "CMX (MiT-B2)"),
        ("CMX-B2", "CMX (MiT-B2)"),
        ("rtfnet-152", "RTFNet (ResNet-152)"),
        ("RTFNet ResNet-50", "RTFNet (ResNet-50)"),
        ("sigma=H/4", "sigma=H/4"),
        ("Ours", "Ours"),
    ],
)
def test_a_label_is_found_in_several_spellings(folder: Path, name: str, label: str) -> None:
    found, others = external_rows([f"predictions.{name}={folder}", "seed=1"], TABLE)
    assert found == [ExternalRow(label, "predictions", folder)]
    assert others == ["seed=1"]


def test_rows_are_in_the_order_of_the_table(folder: Path) -> None:
    weights = folder.parent / "a=b.pth"
    words = [f"weights.CMX={weights}", "dataset=mfnet", f"predictions.B={folder}"]
    found, others = external_rows(words, TABLE)
    assert found == [
        ExternalRow("(B)", "predictions", folder),
        ExternalRow("CMX (MiT-B2)", "weights", weights),
    ]
    assert others == ["dataset=mfnet"]


WRONG = {
    "typo": ("predictions.Orus={folder}", "has no row 'Orus'; did you mean 'Ours'"),
    "not the first word": ("predictions.MFNet={folder}", "has no row 'MFNet'"),
    "several": ("predictions.RTFNet={folder}", "'RTFNet' may be any of the rows 'RTFNet (ResNet-"),
    "no path": ("weights.A", "expected weights.LABEL=FILE"),
    "a folder": ("weights.A={folder}", "is not a file of weights; give the path of one"),
    "a file": ("predictions.A={folder}/x.png", "is not a folder of predicted label images"),
    "nothing": ("predictions.A=", "is not a folder of predicted label images"),
    "a network": (
        "weights.mask2former_swin_t={folder}",
        "Initial weights of trained rows are given with pretrained.mask2former_swin_t=FILE",
    ),
}


@pytest.mark.parametrize(("word", "sentence"), WRONG.values(), ids=WRONG)
def test_a_wrong_word_is_refused(folder: Path, word: str, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        external_rows([word.format(folder=folder)], TABLE)
    assert sentence in str(error.value)


def test_a_row_has_one_source_and_weights_need_a_network(folder: Path) -> None:
    word = f"predictions.A={folder}"
    with pytest.raises(InputError, match=r"row '\(A\)' already has predictions"):
        external_rows([word, f"predictions.(A)={folder}"], TABLE)
    printed = table_of("CMNeXt")
    with pytest.raises(InputError, match="has no network that weights can be loaded into; give"):
        external_rows([f"weights.CMNeXt={folder.parent / 'a=b.pth'}"], printed)
    assert external_rows([f"predictions.cmnext={folder}"], printed)[0][0].label == "CMNeXt"


@pytest.mark.parametrize(
    "value",
    ["/data/MF net", "a=b", "it's", r"C:\d", r"a\'b", "end\\", "", "null", "NaN", "12", "{a}"]
    + [1, 0.5, None, True, ["a b", 1, None], ("x",)],
)
def test_as_typed_is_read_back_by_hydra(value: Any) -> None:
    read = OverridesParser.create().parse_override(f"key={as_typed(value)}").value()
    plain = getattr(read, "text", read)
    assert plain == (list(value) if isinstance(value, tuple) else value)
    assert type(plain) is type(list(value) if isinstance(value, tuple) else value)


@pytest.mark.parametrize("scale", ["demo", "paper"])
def test_words_of_the_data_set_give_the_same_node_in_another_command(scale: str) -> None:
    """The data set of a row, its scale included, without the row's experiment."""
    rows = table_of("a", experiment="mfnet", overrides=("dataset.num_test=3", "dataset.seed=2"))
    settings: Any = {"scale": "demo", "form": "paper", "base": ["tracking=none"]}
    data = data_of(rows, {**settings, "extra": ["dataset.absent=exclude", "metric=ring9"]})
    for group in ("dataset", "metric"):
        again = compose([f"scale={scale}", *data.words(group, scale)])
        assert again[group] == data.config[group]
    assert data.regions("as trained").name == "ring9"
    assert data.regions("vertical5").name == "vertical5"


def test_content_hash_covers_names_and_contents(tmp_path: Path) -> None:
    folder = tmp_path / "predicted"
    folder.mkdir()
    seen = {content_hash(folder)}
    for name, content in (("a.png", b"1"), ("b.png", b"1"), ("b.png", b"2"), ("c.png", b"")):
        (folder / name).write_bytes(content)
        seen.add(content_hash(folder))
    assert len(seen) == 5
    before = content_hash(folder)
    (folder / ".DS_Store").write_bytes(b"")
    moved = folder.rename(tmp_path / "moved")
    assert content_hash(moved) == before


def test_table_iv_of_temporal_has_tc_and_ca_of_both_protocols() -> None:
    """A row of predictions gets them from the folder of its mIoU."""
    table = load_table("temporal/table4")
    counted = {column.name: evaluation_of(column, table) for column in table.columns}
    frames = {name: each.frames for name, each in counted.items() if each is not None}
    assert frames == {
        **{"TC": "released", "CA": "released"},
        **{"TC aligned": "aligned", "CA aligned": "aligned"},
    }
    assert not any(column.printed for column in table.columns if column.name in frames)
