"""The record in which a component declares what it provides and what it requires of others.

The attribute `record` of a network, loss, scheme, ...; `check_requirements` compares them before
anything is trained.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

from rgbt.checks import InputError, described
from rgbt.types import VIEWS, View

Outputs = Literal["scores", "masks"]  # in training: dense class scores, or masks of queries


@dataclass(frozen=True)
class Requirement:
    """One thing that a component requires of another one.

    Attributes:
        node: key of the other component in the configuration, such as "model".
        key: attribute of its `Record`, or a key of `Record.others`.
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
        """Whether a component with this record meets it; None in a record is not compared."""
        provided = record.get(self.key)
        if isinstance(provided, tuple):
            return set(self.value) <= set(provided)
        return provided is None or bool(provided == self.value)

    def inside(self, node: str) -> Requirement:
        """The same, where `setting` is relative to `node`."""
        return replace(self, setting=f"{node}.{self.setting}")

    @classmethod
    def of_background(cls, setting: str) -> Requirement:
        """Class 0 is the background, because of `setting`."""
        advice = "name class 0 in dataset.background if it is no object"
        return cls("dataset", "first_class", "background", setting, advice)


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a component provides and requires.

    Attributes:
        requires: of other components.
        outputs: network: what it returns in training.
        views: network: input images it can predict from; it is evaluated with the first one.
        heads: network and domains: their names.
        auxiliary: network: whether it returns `aux["aux_logits"]`.
        features: network: whether it returns `aux["features"]`.
        stacks_passes: network: whether `forward` takes `passes`, as `rgbt.models.mask2former` does.
        dense_logits: network: whether its method `dense_logits` converts masks to class scores.
        pretrained_parts: network: beginnings of parameters of ImageNet files (backbone's rate).
        recomputed: network: modules that `trainer.activation_checkpointing` computes again (* in a
            name: no dot); they draw nothing and do not contain each other.
        pretrained: `model.weights`: whether any are named.
        drawn_anew: network: beginnings of names of parameters that no file replaces -> why.
        author_names: network from elsewhere: beginning of its names here and in its author's files
        reads_auxiliary: loss: whether it reads `aux["aux_logits"]`.
        weighs_confidence: loss: whether it weighs pixels by the confidence of their labels.
        frames: loss and scheme: how many frames of a scene it takes.
        reads_warped: loss of two frames: whether it reads the first prediction in the second frame.
        compares_half: such a loss: whether it compares them at half the size too.
        num_domains: scheme and domains: 1 or 2.
        shows_views: scheme: whether a domain's view and head are passed on to the network.
        optimizers: scheme: name -> beginnings of parameters of the network that it leaves out.
        networks: scheme: further modules of a checkpoint; Fabric wraps trained ones in place.
        builders: scheme: of the optimizers of the `networks` that are trained.
        camera: scheme and view of a second frame: the `rgbt.geometry.camera.Camera` that draws it.
        hides_cells: masker: whether any cell is ever hidden.
        crop_hw: transform: size of a training example; None where that differs.
        for_target: transform: that of the target domain; None: itself.
        target_labels: domains: whether the target has labels.
        target_confidence: domains: whether these carry a confidence.
        separate_heads: domains: whether source and target have a head each.
        num_classes: data set: K.
        first_class: data set: whether class 0 is its background or an object.
        others: further values that a user's own components share, by name.
    """

    requires: tuple[Requirement, ...] = ()
    outputs: Outputs = "scores"
    views: tuple[View, ...] = VIEWS
    heads: tuple[str, ...] = ()
    auxiliary: bool = False
    features: bool = False
    stacks_passes: bool = False
    dense_logits: bool = False
    pretrained_parts: tuple[str, ...] = ()
    recomputed: tuple[str, ...] = ()
    pretrained: bool = False
    drawn_anew: Mapping[str, str] = field(default_factory=dict)
    author_names: tuple[str, str] | None = None
    reads_auxiliary: bool = False
    weighs_confidence: bool = False
    frames: Literal[1, 2] = 1
    reads_warped: bool = False
    compares_half: bool = False
    num_domains: Literal[1, 2] = 1
    shows_views: bool = False
    optimizers: Mapping[str, tuple[str, ...]] = field(default_factory=partial(dict, main=()))
    networks: dict[str, Any] = field(default_factory=dict)
    builders: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    camera: Any = None
    hides_cells: bool = True
    crop_hw: tuple[int, int] | None = None
    for_target: Any = None
    target_labels: bool = False
    target_confidence: bool = False
    separate_heads: bool = False
    num_classes: int | None = None
    first_class: Literal["background", "object"] | None = None
    others: Mapping[str, Any] = field(default_factory=dict)

    def get(self, key: str) -> Any:
        """The value of `key`, also in `others`; False where there is none."""
        return {**vars(self), **self.others}.get(key, False)


# The record of a component that does not declare one.
PLAIN = Record()

# Records by node for undeclared components that are not `PLAIN`: a loss reads class scores.
WITHOUT_RECORD = {"loss": Record(requires=(Requirement("model", "outputs", "scores"),))}


def record_of(component: object, default: Record = PLAIN) -> Record:
    """The record of a component; InputError where it is something else."""
    record = getattr(component, "record", default)
    if not isinstance(record, Record):
        name = f"{type(component).__name__}.record"
        raise InputError(f"{name} is {described(record)}; expected rgbt.requirements.Record.")
    return record


def check_requirements(components: Mapping[str, Any]) -> dict[str, Record]:
    """The records of components, by their keys in the configuration.

    InputError names the first requirement, in their order, that another component does not meet.
    """
    records = {
        node: record_of(part, WITHOUT_RECORD.get(node, PLAIN)) for node, part in components.items()
    }
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
    """The name of a function or class, or of the class of an object."""
    is_callable = inspect.isfunction(component) or inspect.isclass(component)
    return str(component.__name__) if is_callable else type(component).__name__
