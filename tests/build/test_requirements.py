"""The resolver: which requirement fails, and which files of conf/ are offered instead."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from rgbt.build.requirements import check_requirements
from rgbt.checks import InputError
from rgbt.config.component import Component
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


def node(group: str, plain: dict[str, Any]) -> Any:
    return Component.from_node(OmegaConf.create(plain)[group]).build()


class Asking:
    """Requires something of another component."""

    def __init__(self, *requires: Requirement) -> None:
        self.record = Record(requires=requires)


class Nothing:
    """Has no record."""


MISSING: dict[str, tuple[Requirement, dict[str, Any], str]] = {
    "frames of the loss": (
        Requirement("loss", "frames", 2),
        {"loss": Nothing()},
        "Asking requires frames=2 of the loss, Nothing provides frames=1; choose "
        "loss=temporal_paper, temporal_released.",
    ),
    "confidence": (
        Requirement("loss", "weighs_confidence", True, "domains.target.confidence=true"),
        {"loss": Nothing()},
        "Asking with domains.target.confidence=true requires weighs_confidence=true of the loss, "
        "Nothing provides weighs_confidence=false; choose loss=cross_entropy, "
        "cross_entropy_auxiliary, or change domains.target.confidence.",
    ),
    "whole images": (
        Requirement("masker", "hides_cells", False),
        {"masker": Nothing()},
        "requires hides_cells=false of the masker, Nothing provides hides_cells=true; choose "
        "masker=none.",
    ),
    "batches": (
        Requirement("transform", "works_on_batches", True),
        {"transform": Nothing()},
        "provides works_on_batches=false; choose transform=crm, flip, none.",
    ),
    "a target with confidence": (
        Requirement("domains", "target_confidence", True),
        {"domains": Nothing()},
        "provides target_confidence=false; choose domains=heatnet.",
    ),
    "classes": (
        Requirement("dataset", "num_classes", 5, "loss.num_classes=5"),
        {"dataset": Asking()},
        "",
    ),
    "what no file provides": (
        Requirement("masker", "shift", True),
        {"masker": Nothing()},
        "requires shift=true of the masker, Nothing provides shift=false; change asking or masker.",
    ),
}


@pytest.mark.parametrize(("requirement", "other", "expected"), MISSING.values(), ids=MISSING.keys())
def test_missing_capability_names_the_choices(
    requirement: Requirement, other: dict[str, Any], expected: str
) -> None:
    components = {"asking": Asking(requirement), **other}
    if expected:
        assert expected in sentence(components)
    else:
        check_requirements(components, PLAIN)  # None is not compared


def test_missing_views_name_networks_that_have_them() -> None:
    asking = Asking(Requirement("model", "stacks_passes", True))
    found = sentence({"asking": asking, "model": Nothing()})
    names = re.search(r"choose model=(.*)\.$", found)
    assert names is not None
    assert all(name.startswith("mask2former") for name in names[1].split(", "))


def test_other_data_set_is_never_a_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(plain: Any, group: str) -> Any:
        assert group != "dataset", "to build a data set may write files"
        return iter(())

    monkeypatch.setattr("rgbt.build.requirements.choices", refuse)
    required = Requirement("dataset", "num_classes", 5, "loss.num_classes=5")
    data = Nothing()
    data.record = Record(num_classes=9)  # type: ignore[attr-defined]
    assert sentence({"asking": Asking(required), "dataset": data}) == (
        "Asking with loss.num_classes=5 requires num_classes=5 of the dataset, Nothing provides "
        "num_classes=9; change loss.num_classes."
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


def test_components_that_fit_pass() -> None:
    components = {key: node(key, PLAIN) for key in ("loss", "masker", "transform")}
    model = Nothing()
    model.record = Record(outputs="masks", num_classes=9)  # type: ignore[attr-defined]
    check_requirements({**components, "model": model}, PLAIN)


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
    with pytest.raises(InputError, match=rf"Mine\.{name} is not read; .*Record\({key}=\.\.\.\)"):
        record_of(component)
