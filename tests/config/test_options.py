"""Options that are declared once: how words become values, what is refused, what --help shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.options import Help, help_text, parse


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
    extra: Annotated[dict[str, Any], Help("more")] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("split=2", "2"),
        ("split=a=b c", "a=b c"),
        ("split=", ""),
        ("out=~/x", Path.home() / "x"),
        ("out=", None),
        ("out=null", None),
        ("count=9", 9),
        ("level=1", 1.0),
        ("level=1e-3", 0.001),
        ("dry_run=true", True),
        ("blocks=none", "none"),
        ("blocks=12", 12),
        ("gpus=[0,1]", (0, 1)),
        ("gpus=0,1", (0, 1)),
        ("gpus=null", None),
        ("slots=[0,[1,2]]", (0, (1, 2))),
        ("slots=[[0,1],[2]]", ((0, 1), (2,))),
        ("extra={a: 1}", {"a": 1}),
    ],
)
def test_parse_word_gives_typed_value(word: str, value: object) -> None:
    options, overrides = parse(Options, ["run=x", word])
    assert getattr(options, word.partition("=")[0]) == value
    assert overrides == []


MISTAKES = {
    "count=10": "'count' must be a whole number from 1 to 9, got 10",
    "count=1,2": "'count' must be a whole number from 1 to 9, got \"1,2\"",
    "count=2.5": "'count' must be a whole number from 1 to 9, got 2.5",
    "level=": "'level' must be a number, got \"\"",
    "level=nan": "'level' must be a number, got NaN",
    "dry_run=maybe": "'dry_run' must be true or false, got \"maybe\"",
    "blocks=all": "'blocks' must be 'auto' or 'none' or a whole number, got \"all\"",
    "gpus=[0,x]": 'must be a whole number, got "x"',
    "": "'run' has no value; give one with run=...",
    "run": "'run': expected key=value; did you mean 'run'?",
    "--run=x": "'--run' is not an option of this command; did you mean 'run'?",
    "spilt=val": "'spilt' is not an option of this command; did you mean 'split'?",
    "datset=mfnet": "'datset' is not an option of this command; did you mean 'dataset'?",
    "max_steps=3": "did you mean trainer.max_steps",
}


@pytest.mark.parametrize("word", MISTAKES)
def test_parse_mistake_is_refused_in_a_sentence(word: str) -> None:
    given = word.split() if not word or word.startswith(("run", "--run")) else ["run=x", word]
    with pytest.raises(InputError) as raised:
        parse(Options, given)
    assert MISTAKES[word] in str(raised.value)


def test_parse_passes_overrides_on() -> None:
    words = ["dataset=mfnet", "dataset.root=/d", "+experiment=grbm", "tracking=none", "seed=2"]
    assert parse(Options, ["run=x", *words])[1] == words


@pytest.mark.parametrize("word", ["metric=ring9", "datasets.root=x", "seed=1"])
def test_parse_refuses_overrides_that_take_no_effect(word: str) -> None:
    heeds = ("dataset", "data.on_error")
    known = ["dataset=mfnet", "dataset.root=/d", "data.on_error=skip", "hydra.searchpath=[x]"]
    assert parse(Options, ["run=x", *known], heeds)[1] == known
    with pytest.raises(InputError, match="has no effect here"):
        parse(Options, ["run=x", word], heeds)


def test_help_shows_each_option_with_choices_and_default() -> None:
    text = help_text("rgbt do", Options, "Do it.\n\nMore words.")
    assert text.startswith("Do it.\n\nusage: rgbt do run=... [option=value ...]\n\n  run")
    assert text.endswith("\n\nMore words.")
    assert "  blocks   drawn together; one of: auto, none (default: auto)\n" in text
    assert "  dry_run  show only (default: false)\n" in text
    assert "  out      folder\n" in text
