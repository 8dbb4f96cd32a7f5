"""Every file passes the schema of its constructor, and every setting has a range."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Gt
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from pydantic import TypeAdapter

from rgbt.checks import InputError
from rgbt.config.component import Component, build, setting_types
from rgbt.config.compose import available, conf_dir
from rgbt.config.values import check_value
from rgbt.ranges import Pixels, Share
from rgbt.runs.run_spec import NODES, VALUES
from tests.models.golden import alone, compose


@dataclass(frozen=True, kw_only=True)
class Knob:
    size: tuple[int, int]
    kind: Literal["a", "b"]
    share: Share = 0.5
    sides: tuple[Pixels, ...] = ()
    scale: Annotated[float, Gt(0)] | None = None
    inner: Knob | None = None
    model: object = None


@pytest.fixture(scope="module")
def default() -> DictConfig:
    """The whole configuration, of which one node at a time is exchanged."""
    return compose()


@pytest.mark.parametrize(
    ("group", "option"), [(g, o) for g in NODES if g != "scale" for o in available(g)]
)
def test_every_option_of_every_group_passes_the_check(
    group: str, option: str, default: DictConfig
) -> None:
    needed = {} if group != "dataset" or option.startswith("synth") else {"root": "unused"}
    if option == "folder":
        needed |= {"num_classes": 2, "classes": "[a,b]", "rgb": "a", "thermal": "b", "label": "c"}
    if option == "cart":
        needed |= {"thermal_range": "[0,9]"}
    words = [f"dataset.{key}={needed[key]}" for key in needed]
    if option == "external":
        words = ["model.checkout=unused", "model.constructor=a:B"]
    chosen = alone(f"{group}/{option}", *words)
    usual = default[group]
    try:
        default[group] = chosen[group]
        component = Component.from_node(default[group], group)
    finally:
        default[group] = usual
    assert component.target == component.plain["_target_"] == chosen[group]["_target_"]


def test_node_is_built_with_converted_values_and_offered_objects() -> None:
    inner = {"_target_": f"{__name__}.Knob", "size": [3, 4], "kind": "b"}
    node = OmegaConf.create({"knob": {**inner, "kind": "a", "inner": inner}}).knob
    offered = object()
    knob = build(node, model=offered, unused=1)
    assert (knob.size, knob.kind, knob.model) == ((3, 4), "a", offered)
    assert (knob.inner.size, knob.inner.kind, knob.inner.model) == ((3, 4), "b", offered)
    with pytest.raises(InputError, match="'knob.size' has no value"):
        build(OmegaConf.create({"knob": {"_target_": f"{__name__}.Knob", "kind": "a"}}).knob)


NAN, INFINITE = float("nan"), float("inf")
WRONG: list[tuple[dict[str, Any], str]] = [
    *(({"size": size}, "'knob.size[1]'") for size in ([1], [1, 2.5], [1, True], [1, "2"])),
    ({"kind": "c"}, "'knob.kind'"),
    ({"share": 1.5}, "'knob.share'"),
    ({"share": NAN}, "'knob.share'"),
    ({"scale": 0}, "'knob.scale'"),
    ({"scale": INFINITE}, "'knob.scale'"),
    ({"sides": [4, 0]}, "'knob.sides[1]'"),
    ({"kin": "a"}, "'knob.kin' is not a setting"),
    ({"kind": "???"}, "'knob.kind' has no value"),
    ({"kind": "${nowhere}"}, "nowhere"),
    ({"inner": {"_target_": "no.such.Thing"}}, "'knob.inner._target_'"),
    ({"_target_": "no.such.Thing"}, "'knob._target_'"),
]


@pytest.mark.parametrize(("change", "sentence"), WRONG)
def test_wrong_values_are_named_with_their_key(change: dict[str, Any], sentence: str) -> None:
    good = {"_target_": f"{__name__}.Knob", "size": [1, 2], "kind": "a"}
    with pytest.raises(InputError) as raised:
        Component.from_node(OmegaConf.create({"knob": {**good, **change}}).knob, "knob")
    assert sentence in str(raised.value)
    assert str(raised.value).isprintable()


TEXTS = "".join(path.read_text() for path in conf_dir().rglob("*.yaml"))
TARGETS = sorted(set(re.findall(r"_target_: (rgbt[\w.]+)", TEXTS)))
"""Constructors that the configuration names."""

LOW, HIGH = ("minimum", "exclusiveMinimum"), ("maximum", "exclusiveMaximum")


def unbounded(schema: Any) -> list[Any]:
    """Numbers without both ends, and texts of any length, in a JSON schema."""
    if not isinstance(schema, dict):
        return (
            [found for part in schema for found in unbounded(part)] if type(schema) is list else []
        )
    if {"enum", "const"} & set(schema):
        return []
    kind = schema.get("type")
    has_ends = all(any(end in schema for end in ends) for ends in (LOW, HIGH))
    is_open = kind in ("integer", "number") and not has_ends
    is_long = kind == "string" and not {"maxLength", "format"} & set(schema)
    inner = [
        unbounded(part) for key, part in schema.items() if key not in ("enum", "propertyNames")
    ]
    return [*([schema] if is_open or is_long else []), *(found for part in inner for found in part)]


@pytest.mark.parametrize("target", [*TARGETS, "sweeps.settings.SweepSettings"])
def test_every_number_and_text_has_a_range(target: str) -> None:
    for key, annotation in setting_types(get_object(target)).items():
        try:
            schema = TypeAdapter(annotation).json_schema()
        except Exception:  # an object that the run provides
            continue
        assert not unbounded(schema), f"{target}.{key}: declare a range (rgbt.ranges)"


@pytest.mark.parametrize("wrong", [-1, 2**32, True, 0.5, None])
def test_top_level_keys_have_a_range(wrong: Any) -> None:
    assert not unbounded(TypeAdapter(VALUES["seed"]).json_schema())
    assert check_value("seed", 0, VALUES["seed"]) == 0
    with pytest.raises(InputError, match="^'seed'"):
        check_value("seed", wrong, VALUES["seed"])
