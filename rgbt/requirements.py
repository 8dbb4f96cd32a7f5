"""The records in which components declare what they provide and what they require of others.

A component has its record as the attribute `record`; `KINDS` names the record of each node of the
configuration. `check_requirements` compares them before anything is trained. What our own
components require:

    ==========================  =====================================================
    component                   requires
    ==========================  =====================================================
    loss                        model.outputs; dataset.num_classes, .first_class
    loss of two frames          scheme.frames, and what its loss of each frame requires
    loss with auxiliary scores  model.auxiliary
    scheme crm                  model.views, .stacks_passes; masker.hides_cells
    scheme temporal             loss.frames, .compares_half; masker.hides_cells;
                                model.dense_logits; what its view requires
    schemes of two domains      model.outputs, .auxiliary, .features; masker.hides_cells;
                                domains.num_domains, .separate_heads, .target_labels,
                                .target_confidence; loss.weighs_confidence;
                                dataset.num_classes; weights that the model starts from
    domains                     scheme.num_domains, .shows_views; model.views, .heads;
                                loss.weighs_confidence
    network                     domains.heads; loss.reads_auxiliary
    view                        dataset.first_class
    prediction                  model.outputs
    ==========================  =====================================================
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

from rgbt.checks import InputError, described
from rgbt.types import VIEWS, View

Outputs = Literal["scores", "masks"]  # in training: dense class scores, or masks of queries


@dataclass(frozen=True)
class Requirement:
    """One thing that a component requires of another one.

    Attributes:
        node: key of the other component in the configuration, such as "model".
        key: attribute of its record, or a key of `Record.others`.
        value: required value; of a tuple, the values that it must contain.
        setting: that causes the requirement, "scheme.guidance_weight=0.01"; "": always required.
        advice: what a user does to meet it, other than to choose another file of ``conf/``.
    """

    node: str
    key: str
    value: Any
    setting: str = ""
    advice: str = ""

    def is_met_by(self, record: Record) -> bool:
        """Say whether a component with this record meets it; None in a record is not compared."""
        provided = record.get(self.key)
        if isinstance(provided, tuple):
            return set(self.value) <= set(provided)
        return provided is None or bool(provided == self.value)

    def inside(self, node: str) -> Requirement:
        """Return the same requirement for a `setting` that is relative to `node`."""
        return replace(self, setting=f"{node}.{self.setting}")

    @classmethod
    def of_background(cls, setting: str) -> Requirement:
        """Require that class 0 is the background, because of `setting`."""
        advice = "name class 0 in dataset.background if it is no object"
        return cls("dataset", "first_class", "background", setting, advice)


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a component of any kind states.

    Attributes:
        requires: of other components.
        others: further values that a user's own components share, by name.
    """

    requires: tuple[Requirement, ...] = ()
    others: Mapping[str, Any] = field(default_factory=dict)

    def get(self, key: str) -> Any:
        """Return the value of `key`, also in `others`; False where there is none."""
        return {**vars(self), **self.others}.get(key, False)


@dataclass(frozen=True, kw_only=True)
class NetworkRecord(Record):
    """What a network states.

    Attributes:
        outputs: what it returns in training.
        views: input images it can predict from; it is evaluated with the first one.
        heads: their names.
        auxiliary: whether it returns `aux["aux_logits"]`.
        features: whether it returns `aux["features"]`.
        stacks_passes: whether `forward` takes `passes`, as `rgbt.models.mask2former` does.
        dense_logits: whether its method `dense_logits` converts masks to class scores.
        pretrained_parts: beginnings of parameters of ImageNet files (backbone's rate).
        recomputed: modules that `trainer.activation_checkpointing` computes again (* in a name: no
            dot); they draw nothing and do not contain each other.
        drawn_anew: beginnings of names of parameters that no file replaces -> why.
        author_names: of a network from elsewhere: beginning of its names here and in its author's
            files.
    """

    outputs: Outputs = "scores"
    views: tuple[View, ...] = VIEWS
    heads: tuple[str, ...] = ()
    auxiliary: bool = False
    features: bool = False
    stacks_passes: bool = False
    dense_logits: bool = False
    pretrained_parts: tuple[str, ...] = ()
    recomputed: tuple[str, ...] = ()
    drawn_anew: Mapping[str, str] = field(default_factory=dict)
    author_names: tuple[str, str] | None = None


@dataclass(frozen=True, kw_only=True)
class LossRecord(Record):
    """What a loss states.

    Attributes:
        reads_auxiliary: whether it reads `aux["aux_logits"]`.
        weighs_confidence: whether it weighs pixels by the confidence of their labels.
        frames: how many frames of a scene it takes.
        reads_warped: of two frames: whether it reads the first prediction in the second frame.
        compares_half: of two frames: whether it compares them at half the size too.
    """

    reads_auxiliary: bool = False
    weighs_confidence: bool = False
    frames: Literal[1, 2] = 1
    reads_warped: bool = False
    compares_half: bool = False


@dataclass(frozen=True, kw_only=True)
class SchemeRecord(Record):
    """What a scheme states.

    Attributes:
        frames: how many frames of a scene it takes.
        num_domains: 1 or 2.
        shows_views: whether a domain's view and head are passed on to the network.
        optimizers: name -> beginnings of parameters of the network that it leaves out.
        networks: further modules of a checkpoint; Fabric wraps trained ones in place.
        builders: of the optimizers of the `networks` that are trained.
        camera: the `rgbt.geometry.camera.Camera` that draws its second frame.
    """

    frames: Literal[1, 2] = 1
    num_domains: Literal[1, 2] = 1
    shows_views: bool = False
    optimizers: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"main": ()})
    networks: dict[str, Any] = field(default_factory=dict)
    builders: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    camera: Any = None


@dataclass(frozen=True, kw_only=True)
class DomainsRecord(Record):
    """What the domains state.

    Attributes:
        num_domains: 1 or 2.
        heads: names of their heads of the network.
        separate_heads: whether source and target have a head each.
        target_labels: whether the target has labels.
        target_confidence: whether these carry a confidence.
    """

    num_domains: Literal[1, 2] = 1
    heads: tuple[str, ...] = ()
    separate_heads: bool = False
    target_labels: bool = False
    target_confidence: bool = False


@dataclass(frozen=True, kw_only=True)
class DatasetRecord(Record):
    """What a data set states; None is not compared.

    Attributes:
        num_classes: K.
        first_class: whether class 0 is its background or an object.
    """

    num_classes: int | None = None
    first_class: Literal["background", "object"] | None = None


@dataclass(frozen=True, kw_only=True)
class TransformRecord(Record):
    """What a transform states.

    Attributes:
        crop_hw: size of a training example; None where that differs.
        for_target: the transform of the target domain; None: itself.
    """

    crop_hw: tuple[int, int] | None = None
    for_target: Any = None


@dataclass(frozen=True, kw_only=True)
class MaskerRecord(Record):
    """What a masker states: whether any cell is ever hidden."""

    hides_cells: bool = True


# Node of the configuration -> kind of its record; all others state their requirements alone, but
# "network of KEY" (the network of the upstream run that a setting names), which is a network.
KINDS: dict[str, type[Record]] = {
    "model": NetworkRecord,
    "loss": LossRecord,
    "scheme": SchemeRecord,
    "domains": DomainsRecord,
    "dataset": DatasetRecord,
    "transform": TransformRecord,
    "masker": MaskerRecord,
}

# What a loss without a record requires.
READS_SCORES = LossRecord(requires=(Requirement("model", "outputs", "scores"),))

R = TypeVar("R", bound=Record)


def record_of(component: object, kind: type[R]) -> R:
    """Return the record of a component, or an empty one of its `kind` where it has none.

    InputError: its record is of another kind.
    """
    try:
        record: object = component.record  # type: ignore[attr-defined]
    except AttributeError:
        if inspect.getattr_static(component, "record", None) is not None:
            raise  # by the property itself
        return kind()
    if not isinstance(record, kind):
        name = f"{type(component).__name__}.record"
        expected = f"rgbt.requirements.{kind.__name__}"
        raise InputError(f"{name} is {described(record)}; expected {expected}.")
    return record


def check_requirements(components: Mapping[str, Any]) -> dict[str, Any]:
    """Compare what components, by their keys in the configuration, require of each other.

    Returns:
        The record of each component, of the kind that `KINDS` names.

    Raises:
        InputError: the first requirement, in their order, that another component does not meet.
    """
    records: dict[str, Record] = {}
    for node, component in components.items():
        kind = NetworkRecord if node.startswith("network of ") else KINDS.get(node, Record)
        records[node] = record_of(component, kind)
    if "loss" in components and not hasattr(components["loss"], "record"):
        records["loss"] = READS_SCORES
    for node, record in records.items():
        for need in record.requires:
            other = records.get(need.node)
            if other is None or need.is_met_by(other):
                continue
            subject = name_of(components[node]) + (f" with {need.setting}" if need.setting else "")
            change = need.advice or f"change {need.setting.partition('=')[0] or node}"
            raise InputError(
                f"{node}: {subject} requires {need.key}={need.value} of the {need.node}, "
                f"which provides {need.key}={other.get(need.key)}; "
                f"{change}, or choose another {need.node}."
            )
    return records


def name_of(component: Any) -> str:
    """Return the name of a function or class, or of the class of an object."""
    is_callable = inspect.isfunction(component) or inspect.isclass(component)
    return str(component.__name__) if is_callable else type(component).__name__
