"""Options that are declared once: how words become values, what is refused, what --help shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Interval

from rgbt.checks import InputError, split_list
from rgbt.config.compose import compose
from rgbt.config.options import Help, parse, readable_paths


@dataclass(frozen=True)
class Options:
    run: Annotated[str, Help("run folder")]
    split: Annotated[str, Help("of the data set")] = "test"
    out: Annotated[Path | None, Help("folder")] = None
    count: Annotated[int, Interval(ge=1, le=9), Help("how many")] = 3
    level: Annotated[float, Help("share")] = 0.95
    dry_run: Annotated[bool, Help("show only")] = False
    blocks: Annotated[Literal["auto", "none"] | int, Help("drawn together")] = "auto"
    gpus: Annotated[tuple[int, ...] | None, Help("numbers")] = None
    slots: Annotated[tuple[int | tuple[int, ...], ...] | None, Help("numbers")] = None
    runs: Annotated[tuple[str, ...], Help("folders")] = ()
    extra: Annotated[dict[str, Any], Help("more")] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("word", "value"),
    [
        *(("split=2", "2"), ("split=a=b c", "a=b c"), ("split=", "")),
        *(("out=~/x", Path.home() / "x"), ("out=", None), ("out=null", None), ("count=9", 9)),
        *(("level=1", 1.0), ("level=1e-3", 0.001), ("dry_run=true", True)),
        *(("blocks=none", "none"), ("blocks=12", 12), ("gpus=[0,1]", (0, 1)), ("gpus=0,1", (0, 1))),
        ("slots=[0,[1,2]]", (0, (1, 2))),
        ("slots=[[0,1],[2]]", ((0, 1), (2,))),
        ("runs=a,1", ("a", "1")),
        ("runs=[crm sizes=[2,4], grbm]", ("crm sizes=[2,4]", "grbm")),
        ("extra={a: 1}", {"a": 1}),
    ],
)
def test_parse_word_gives_typed_value(word: str, value: object) -> None:
    options, overrides = parse(Options, ["run=x", word])
    assert getattr(options, word.partition("=")[0]) == value
    assert overrides == []


@pytest.mark.parametrize(
    ("words", "key"),
    [
        *(("", "run"), ("run", "run"), ("--run=x", "--run"), ("run=x spilt=val", "split")),
        *(
            ("run=x count=10", "count"),
            ("run=x level=nan", "level"),
            ("run=x dry_run=maybe", "dry_"),
        ),
        *(("run=x blocks=all", "blocks"), ("run=x gpus=[0,x]", "gpus[1]")),
        *(("run=x datset=mfnet", "dataset"), ("run=x max_steps=3", "trainer.max_steps")),
    ],
)
def test_parse_mistake_is_named(words: str, key: str) -> None:
    with pytest.raises(InputError) as raised:
        parse(Options, words.split())
    assert key in str(raised.value)


@pytest.mark.parametrize("word", ["metric=ring9", "datasets.root=x", "seed=1"])
def test_parse_refuses_overrides_that_take_no_effect(word: str) -> None:
    known = ["dataset=mfnet", "dataset.root=/d", "data.on_error=skip", "hydra.searchpath=[x]"]
    assert parse(Options, ["run=x", *known], ("dataset", "data.on_error"))[1] == known
    assert parse(Options, ["run=x", *known, "+experiment=grbm"])[1] == [*known, "+experiment=grbm"]
    with pytest.raises(InputError, match="has no effect here"):
        parse(Options, ["run=x", word], ("dataset", "data.on_error"))


def test_paths_are_read_as_they_are_typed() -> None:
    typed = ["model.weights=a/epoch=299 (best).ckpt", "dataset.root=~/MF", "model.weights=a,b"]
    first, root, grid, *others = readable_paths([*typed, "masker.sigma_div=1,2", "-m"])
    assert compose([first]).model.weights == "a/epoch=299 (best).ckpt"
    assert root == f"dataset.root={Path.home()}/MF"
    assert [grid, *others] == ["model.weights=a,b", "masker.sigma_div=1,2", "-m"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(("a", ["a"]), ("a, b", ["a", "b"]), ("[a]", ["a"])),
        ("[crm sizes=[240,480], grbm]", ["crm sizes=[240,480]", "grbm"]),
        ("x=[1,2],y=[3,4]", ["x=[1,2]", "y=[3,4]"]),
    ],
)
def test_lists_are_read_in_one_way(text: str, expected: list[str]) -> None:
    assert split_list(text, "runs") == expected
    for wrong in ("", "a,", ",a", "a,,b", "[]", "[a,]"):
        with pytest.raises(InputError, match="expected runs"):
            split_list(wrong, "runs")
