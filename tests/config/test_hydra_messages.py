"""What a mistake on the command line says: what was meant, and what to type."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.checks import InputError, split_list
from rgbt.config.command import composing
from rgbt.config.compose import compose
from rgbt.config.hydra_messages import check_words


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("experiment=grbm",), "'experiment=grbm' needs a plus: +experiment=grbm."),
        (("debug=smoke",), "'debug=smoke' needs a plus: +debug=smoke."),
        (("search=grbm",), "'search=grbm' needs a plus: +search=grbm."),
        (("+dataset=mfnet",), "remove the plus from '+dataset=mfnet': dataset=mfnet."),
        (
            ("+experiment=grbm", "+experiment=crm"),
            "+experiment= is given more than once; remove all but one.",
        ),
        (("experiment",), "'experiment' is not a valid override; expected +experiment=NAME."),
        (("crm_kp",), "'crm_kp' is not a valid override; expected +experiment=crm_kp."),
        (("nothing",), "'nothing' is not a valid override; expected key=value"),
        (("seed=0,1",), "'seed=0,1' holds several values. Add -m to run a grid"),
        (("lr=1",), "'lr' is not a key of the configuration; did you mean optimizer.lr?"),
        (("dataset.root=/x",), "Choose the data set that the folder contains: dataset=mfnet (or"),
        (("dataset.num_trian=1",), "did you mean 'num_train'?"),
        (
            ("scheme=self_training", "scheme.feature_distance.weight=1"),
            "because scheme.feature_distance is null; choose a file of scheme= that sets it.",
        ),
        (
            ("model=external", "model.checkout=/code", "model.stubs={a.b: {}}"),
            "'model.stubs={a.b: {}}' adds keys and needs a plus: '+model.stubs={a.b: {}}'.",
        ),
    ],
)
def test_word_that_hydra_refuses_says_what_to_type(words: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(InputError) as caught, composing(words):
        compose(words)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("--experiment", "'--experiment' is not an option; write settings as +experiment=..."),
        ("--seed=1", "'--seed=1' is not an option; write settings as seed=1."),
        (
            "seed=[0, 1]",
            "'seed=[0, 1]': a run has one seed; for several runs use a grid: -m seed=0,1.",
        ),
        ("seeds=3", "'seeds=3': 'seeds' is a mapping; set the seed of one source (seeds.order=3)"),
        (
            "hydra.searchpath=[file:///no/where]",
            "the folder /no/where does not exist; give the absolute path",
        ),
        (
            "hydra.searchpath=[/no/where]",
            "the folder /no/where does not exist; give the absolute path",
        ),
    ],
)
def test_word_that_hydra_would_misread_is_refused(word: str, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        check_words([word])
    assert sentence in str(caught.value)


def test_word_that_hydra_understands_passes(tmp_path: Path) -> None:
    words = ["-m", "--cfg", "job", "seed=0,1", "+experiment=grbm", "--multirun"]
    check_words([*words, f"hydra.searchpath=[file://{tmp_path},pkg://somewhere,{tmp_path}]"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a", ["a"]),
        ("a, b", ["a", "b"]),
        ("[a,b]", ["a", "b"]),
        ("[a]", ["a"]),
        ("crm sizes=[240,480],grbm", ["crm sizes=[240,480]", "grbm"]),
        ("[crm sizes=[240,480], grbm]", ["crm sizes=[240,480]", "grbm"]),
        ("x=[1,2],y=[3,4]", ["x=[1,2]", "y=[3,4]"]),
    ],
)
def test_lists_are_read_in_one_way(text: str, expected: list[str]) -> None:
    assert split_list(text, "runs") == expected


@pytest.mark.parametrize("text", ["", "a,", ",a", "a,,b", "[]", "[a,]"])
def test_empty_entries_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected runs, separated by commas"):
        split_list(text, "runs")
