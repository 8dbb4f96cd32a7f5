"""The resolver: which requirement fails, and which files of conf/ are offered instead."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from rgbt.build.requirements import check_requirements
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.requirements import Record, Requirement, record_of


def plain_of(*overrides: str) -> dict[str, Any]:
    config = compose(["dataset=mfnet", "dataset.root=/data", *overrides])
    found: Any = OmegaConf.to_container(config, resolve=True)
    return found


PLAIN = plain_of()


def sentence(components: dict[str, Any], plain: dict[str, Any] = PLAIN) -> str:
    with pytest.raises(InputError) as raised:
        check_requirements(components, plain)
    return str(raised.value)


class Asking:
    """Requires something of another component."""

    def __init__(self, *requires: Requirement) -> None:
        self.record = Record(requires=requires)


class Nothing:
    """Has no record."""


MISSING: list[tuple[Requirement, str]] = [
    (
        Requirement("loss", "frames", 2),
        "Asking requires frames=2 of the loss, but Nothing provides frames=1; choose "
        "loss=temporal_paper, temporal_released.",
    ),
    (
        Requirement("loss", "weighs_confidence", True, "domains.target.confidence=true"),
        "provides weighs_confidence=false; choose loss=cross_entropy, cross_entropy_auxiliary, or "
        "change domains.target.confidence.",
    ),
    (
        Requirement("loss", "compares_half", True, "scheme.resolution=half"),
        "provides compares_half=false; choose loss=temporal_paper, temporal_released, or change "
        "scheme.resolution.",
    ),
    (
        Requirement("loss", "reads_warped", True, "scheme.pairs=2", advice="name a flow"),
        "provides reads_warped=false; name a flow, or choose loss=temporal_paper, "
        "temporal_released, or change scheme.pairs.",
    ),
    (Requirement("masker", "hides_cells", False), "choose masker=none."),
    (Requirement("transform", "works_on_batches", True), "choose transform=crm, flip, none."),
    (Requirement("domains", "target_confidence", True), "choose domains=heatnet."),
    (Requirement("model", "outputs", "masks"), "choose model=dinov2_tiny, "),
    (Requirement("masker", "shift", True), "provides shift=false; change asking or masker."),
]


@pytest.mark.parametrize(("requirement", "words"), MISSING, ids=[r.key for r, _ in MISSING])
def test_missing_capability_names_the_choices(requirement: Requirement, words: str) -> None:
    assert words in sentence({"asking": Asking(requirement), requirement.node: Nothing()})


def test_loss_without_record_requires_class_scores() -> None:
    class Masks:
        record = Record(outputs="masks")

    found = sentence({"loss": Nothing(), "model": Masks()})
    assert "Nothing requires outputs=scores of the model, but Masks provides outputs=masks" in found
    check_requirements({"loss": Nothing(), "model": Nothing()}, PLAIN)


def test_capability_that_no_record_states_is_not_compared() -> None:
    required = Requirement("dataset", "num_classes", 5, "loss.num_classes=5")
    check_requirements({"asking": Asking(required), "dataset": Asking()}, PLAIN)


def test_other_data_set_is_never_a_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(plain: Any, group: str) -> Any:
        assert group != "dataset", "to build a data set may write files"
        return iter(())

    monkeypatch.setattr("rgbt.build.requirements.choices", refuse)
    required = Requirement("dataset", "num_classes", 5, "loss.num_classes=5")
    data = Nothing()
    data.record = Record(num_classes=9)  # type: ignore[attr-defined]
    assert sentence({"asking": Asking(required), "dataset": data}) == (
        "Asking with loss.num_classes=5 requires num_classes=5 of the dataset, but Nothing "
        "provides num_classes=9; change loss.num_classes."
    )


def test_choice_that_breaks_another_requirement_is_left_out() -> None:
    """Losses of scores weigh by confidence; none of them fits a network of masks."""
    masks = Nothing()
    masks.record = Record(outputs="masks")  # type: ignore[attr-defined]
    required = Requirement("loss", "frames", 2, "scheme.frames=2")
    single = Requirement("scheme", "frames", 1)
    components = {"asking": Asking(required), "loss": Nothing(), "masker": Asking(single)}
    assert "choose loss=temporal_paper, temporal_released, or change" in sentence(components)
    components["model"] = masks
    assert sentence(components).endswith("or change scheme.frames.")


OWN = """
from rgbt.requirements import Record

class Shifted:
    record = Record(others={"shift": True})

class Settable:
    def __init__(self, *, shift: bool) -> None:
        self.shift = shift

    @property
    def record(self) -> Record:
        return Record(others={"shift": self.shift})

class Slow:
    def __init__(self, *, shift: bool) -> None:
        raise RuntimeError

    @staticmethod
    def record_from(*, shift: bool) -> Record:
        return Record(others={"shift": shift})

class Broken:
    def __init__(self) -> None:
        raise RuntimeError
"""


def test_users_component_with_record_is_a_choice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_masks.py").write_text(OWN)
    folder = tmp_path / "conf" / "masker"
    folder.mkdir(parents=True)
    (folder / "shifted.yaml").write_text("_target_: own_masks.Shifted\n")
    (folder / "set.yaml").write_text("_target_: own_masks.Settable\nshift: true\n")
    (folder / "unset.yaml").write_text("_target_: own_masks.Settable\nshift: false\n")
    (folder / "slow.yaml").write_text("_target_: own_masks.Slow\nshift: true\n")
    (folder / "slow_unset.yaml").write_text("_target_: own_masks.Slow\nshift: false\n")
    (folder / "broken.yaml").write_text("_target_: own_masks.Broken\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("RGBT_CONF", str(tmp_path / "conf"))
    asking = Asking(Requirement("masker", "shift", True))
    found = sentence({"asking": asking, "masker": Nothing()})
    assert found.endswith("choose masker=set, shifted, slow.")
    sys.modules.pop("own_masks", None)


@pytest.mark.parametrize(
    ("name", "key"), [("predicts", "outputs"), ("hides_nothing", "hides_cells")]
)
def test_record_of_component_with_former_attribute_is_refused(name: str, key: str) -> None:
    component = type("Mine", (), {name: True})()
    with pytest.raises(InputError, match=rf"Mine\.{name} is ignored; .*Record\({key}=\.\.\.\)"):
        record_of(component)
