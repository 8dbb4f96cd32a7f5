"""Compositions from the cache are those of Hydra, also after a file has changed."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from rgbt.config import compose as composing
from rgbt.config import compose_cache, config_source
from rgbt.config.compose import compose
from rgbt.spec.specify import specify

WORDS = ("+experiment=crm", "masker=square", "masker.patch_size=8", "seed=3", "+model.extra=[1,2]")


@pytest.fixture(autouse=True)
def empty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compose_cache, "_composed", {})
    monkeypatch.setattr(config_source, "_parsed", {})


@pytest.fixture
def composed(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The words of every composition that Hydra made."""
    calls: list[list[str]] = []
    by_hydra = composing._composed_by_hydra

    def watched(words: list[str]) -> object:
        calls.append(words)
        return by_hydra(words)

    monkeypatch.setattr(composing, "_composed_by_hydra", watched)
    return calls


@pytest.mark.parametrize(
    "words",
    [
        (),
        WORDS,
        ("+experiment=temporal_con", "scale.crop_hw=[48,64]", "~trainer.threads"),
        ("model.weights=experiment:crm/last.pt", "name=a"),
    ],
)
def test_compose_gives_what_hydra_gives(words: tuple[str, ...]) -> None:
    expected = composing._composed_by_hydra(list(words))
    for _ in range(2):  # composed, and from the cache
        found = compose(words)
        assert OmegaConf.to_yaml(found) == OmegaConf.to_yaml(expected)
        assert list(found) == list(expected)
        assert OmegaConf.is_struct(found)


def test_compose_sets_values_on_a_copy(composed: list[list[str]]) -> None:
    first = compose(("masker=square", "seed=1"))
    first.masker.patch_size = 99
    second = compose(("masker=square", "seed=2", "trainer.threads=1"))
    assert composed == [["masker=square"]]
    assert (first.seed, second.seed) == (1, 2)
    assert second.masker.patch_size != 99
    compose(("masker=none", "seed=2"))
    assert composed == [["masker=square"], ["masker=none"]]


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("masker.blokc=1", "Could not override"),
        ("masker=squre", "squre"),
        ("seed=1,2", "sweep"),
        ("seed=[1", "LexerNoViableAltException|missing|mismatched|no viable"),
        ("+seed=1", "An item is already at"),
    ],
)
def test_compose_refuses_what_hydra_refuses(word: str, sentence: str) -> None:
    for make in (compose, lambda words: composing._composed_by_hydra(list(words))):
        with pytest.raises(HydraException, match=sentence):
            make(("masker=square", word))


def test_compose_reads_a_changed_file_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "masker" / "mine.yaml"
    file.parent.mkdir()
    monkeypatch.setenv(composing.OWN_FOLDERS, str(tmp_path))
    for number in (1, 2):
        file.write_text(f"_target_: mine.Masker\nvalue: {number}\n")
        assert compose(("masker=mine",)).masker.value == number
    # The same size and time, in another file.
    times = (file.stat().st_atime_ns, file.stat().st_mtime_ns)
    other = tmp_path / "other"
    other.write_text("_target_: mine.Masker\nvalue: 3\n")
    os.utime(other, ns=times)
    other.rename(file)
    assert compose(("masker=mine",)).masker.value == 3
    file.unlink()
    with pytest.raises(HydraException, match="mine"):
        compose(("masker=mine",))


def test_overrides_of_hydra_are_not_cached(composed: list[list[str]], tmp_path: Path) -> None:
    for _ in range(2):
        compose((f"hydra.searchpath=[{tmp_path}]",))
    assert len(composed) == 2
    assert not compose_cache._composed


def test_trials_of_a_search_are_cached(composed: list[list[str]], tmp_path: Path) -> None:
    file = tmp_path / "masker" / "mine.yaml"
    file.parent.mkdir()
    file.write_text("_target_: mine.Masker\nvalue: 1\n")
    hydras = ("hydra.mode=RUN", f"hydra.searchpath=[{tmp_path}]")
    with composing.searching(hydras):
        expected = composing._composed_by_hydra([*hydras, "masker=mine", "seed=2"])
        composed.clear()
        for _ in range(2):
            found = compose((*hydras, "masker=mine", "seed=2"))
            assert OmegaConf.to_yaml(found) == OmegaConf.to_yaml(expected)
    assert composed == [["masker=mine"]]
    with pytest.raises(HydraException, match="mine"):
        compose(("hydra.mode=RUN", "masker=mine"))


VALUES = (
    *("optimizer.lr=0.003", "seed=7", "model.fresh=[a,b]", "model.weights=null"),
    *("name='a, b'", 'name="it\'s"', "scale.crop_hw=[48,64]", "scale.pixel_factor=0.25"),
    *("+model.extra={a:1,b:[x,null]}", "trainer.max_steps=${scale.eval_every}", "out=null"),
    *("scale.few_scenes=true", "data.batch_size=2", "~trainer.threads", "++trainer.threads=2"),
)
CHOICES = (
    *("masker=square", "masker=none", "+experiment=crm", "+experiment=grbm", "scale=paper"),
    *("model=mfnet", "optimizer=adamw", "+debug=smoke"),
)


@pytest.mark.parametrize("seed", range(12))
def test_random_points_are_what_hydra_composes(seed: int) -> None:
    draw = random.Random(seed)
    words = [*draw.sample(CHOICES, 2), *draw.sample(VALUES, 4)]
    draw.shuffle(words)

    def by(make: Callable[[list[str]], object]) -> str:
        try:
            return OmegaConf.to_yaml(make(words))
        except Exception as error:  # refused by both, in the same words
            return f"{type(error).__name__}: {error}"

    assert by(compose) == by(composing._composed_by_hydra), words
    assert by(compose) == by(composing._composed_by_hydra), "from the cache"


def test_files_are_parsed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    compose(("masker=square",))
    parsed = len(config_source._parsed)
    compose(("masker=none", "+experiment=crm"))
    assert parsed < len(config_source._parsed) < 2 * parsed


def test_specify_gives_the_same_key_with_and_without_checked_nodes() -> None:
    first = specify(compose(("masker=square", "seed=1")))
    again = specify(compose(("masker=square", "seed=1")))
    other = specify(compose(("masker=square", "masker.patch_size=8", "seed=1")))
    assert first.key == again.key != other.key
    assert first.components["masker"] is again.components["masker"]
    assert other.components["masker"].plain["patch_size"] == 8
