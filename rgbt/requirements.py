"""The record in which a component declares what it provides and what it requires of others.

A component (network, loss, scheme, masker, transform, domains, ...) states both in one `Record`,
its attribute or property `record`. `rgbt.build.requirements` compares the records of a run before
anything is trained; other code reads a record with `record_of`.
A class that takes long to build has a static method `record_from`, which makes the record of an
object from its settings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from rgbt.checks import InputError, described
from rgbt.types import VIEWS, View

Outputs = Literal["scores", "masks"]
"""What a network returns in training: dense class scores, or masks and classes of queries."""


@dataclass(frozen=True)
class Requirement:
    """One thing that a component requires of another one.

    Attributes:
        node: key of the other component in the configuration, such as "model".
        key: attribute of its `Record`, or a key of `Record.others`.
        value: the required value; where the record holds a tuple, the values that it must contain.
        setting: the setting that causes the requirement, "scheme.guidance_weight=0.01"; "" where
            the component always requires it.
        advice: what a user does to meet it, where that is not to choose another file of ``conf/``.
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
        """The same of a part of the component at `node`; `setting` is then relative to that."""
        return replace(self, setting=f"{node}.{self.setting}")

    @classmethod
    def of_background(cls, setting: str) -> Requirement:
        """Class 0 of the data set is its background, because of this setting."""
        return cls(
            *("dataset", "first_class", "background", setting),
            advice="name class 0 in dataset.background if it is no object",
        )


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a component provides and requires; a component without a record has the defaults.

    Attributes:
        requires: of other components.
        outputs: network: what it returns in training.
        views: network: the input images it can predict from; it is evaluated with the first one.
        heads: network and domains: names of the heads.
        auxiliary: network: whether it returns `aux["aux_logits"]`.
        features: network: whether it returns `aux["features"]`, see `rgbt.models`.
        stacks_passes: network: whether `forward` takes `passes` of a batch, each as its own call;
            one that returns masks also takes `num_predictions` and `num_masks`, see
            `rgbt.models.mask2former.model.Mask2Former.forward`.
        dense_logits: network: whether its method `dense_logits` converts masks to class scores.
        pretrained_parts: network: beginnings of the names of the parameters that an ImageNet file
            covers; they get the backbone's learning rate.
        recomputed: network: names of the modules that `trainer.activation_checkpointing` computes
            again in the backward pass, each on its own; * stands for a part of a name without a
            dot. They draw nothing at random and are not parts of each other.
        pretrained: `model.weights`: whether a file or an upstream run is named.
        drawn_anew: network: beginnings of the names of parameters that are not read from a file
            that has them -> why.
        author_names: network from elsewhere: beginning of its names in `state_dict`, and what is
            there instead in its author's files; None: a network whose names are ours.
        reads_auxiliary: loss: whether it reads `aux["aux_logits"]`.
        weighs_confidence: loss: whether it weighs pixels by the confidence of their labels.
        frames: loss and scheme: how many frames of a scene it takes, 1 or 2.
        reads_warped: loss of two frames: whether it reads the first prediction in the second frame.
        compares_half: such a loss: whether it compares them at half the size too.
        num_domains: scheme and domains: 1 or 2.
        shows_views: scheme: whether a domain's view and head are passed on to the network.
        optimizers: scheme: names that its phases use -> beginnings of the names of the parameters
            of the network that this optimizer leaves out.
        networks: scheme: further modules that are part of a checkpoint, by name; one that is
            trained is replaced by what Fabric makes of it.
        builders: scheme: of the optimizers of those `networks` that are trained, by their names.
        camera: scheme and view of a second frame: the `rgbt.geometry.camera.Camera` that draws it.
        hides_cells: masker: whether any cell is ever hidden.
        crop_hw: transform: size of a training example; None where that differs.
        for_target: transform: the transform of the images of the target domain; None: itself.
        works_on_batches: transform: whether it can augment whole batches on the device.
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
    optimizers: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"main": ()})
    networks: dict[str, Any] = field(default_factory=dict)
    builders: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    camera: Any = None
    hides_cells: bool = True
    crop_hw: tuple[int, int] | None = None
    for_target: Any = None
    works_on_batches: bool = False
    target_labels: bool = False
    target_confidence: bool = False
    separate_heads: bool = False
    num_classes: int | None = None
    first_class: Literal["background", "object"] | None = None
    others: Mapping[str, Any] = field(default_factory=dict)

    def get(self, key: str) -> Any:
        """The value of `key`; False where neither an attribute nor `others` has it."""
        return {**vars(self), **self.others}.get(key, False)


PLAIN = Record()
"""The record of a component that does not declare one."""

FORMER = {
    **{
        "predicts": "outputs",
        "hides_nothing": "hides_cells",
        "reads_confidence": "weighs_confidence",
    },
    **{"reads_warped": "frames", "works_on_batches": "works_on_batches"},
}
"""Former attribute -> key of the record that replaces it."""


def record_of(component: object) -> Record:
    """The record of a component; `PLAIN` where it has none.

    Raises:
        InputError: its attribute `record` is something else, or it has one of `FORMER` instead.
    """
    record = getattr(component, "record", PLAIN)
    former = [name for name in FORMER if record is PLAIN and hasattr(component, name)]
    if former:
        raise InputError(
            f"{type(component).__name__}.{former[0]} is ignored; declare record = "
            f"rgbt.requirements.Record({FORMER[former[0]]}=...) instead, see "
            "docs/how-to/add-other-components.md."
        )
    if not isinstance(record, Record):
        raise InputError(
            f"{type(component).__name__}.record is {described(record)}; expected "
            "rgbt.requirements.Record."
        )
    return record
