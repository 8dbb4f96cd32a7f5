"""The training domains of a run: one, or a labelled source and a target to adapt to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from rgbt.checks import InputError
from rgbt.ranges import ShareBelowOne, Text
from rgbt.requirements import DomainsRecord, Requirement
from rgbt.types import View

GIVEN, NONE = "given", "none"

# Which head predicts an image: that of its domain, or that of one domain for all images.
TestedHead = Literal["own", "source", "target"]


@dataclass(frozen=True, kw_only=True)
class Domain:
    """One domain: its training images, their view and their labels.

    conf/domains/one.yaml describes each setting. `threshold` and `teacher_view` belong to labels
    "experiment:NAME/best.pt", which are predicted with that checkpoint of the run of the experiment
    NAME, with the same seed and on the same data, which is trained first. InputError: confidences
    of labels that have none.
    """

    split: Text
    view: View | None
    head: Text | None
    labels: Text
    teacher_view: View | None = None
    threshold: ShareBelowOne = 0.0
    confidence: bool = False

    def __post_init__(self) -> None:
        if self.confidence and self.labels in (GIVEN, NONE):
            raise InputError(
                f"domains: confidence=true requires pseudo-labels, but labels={self.labels} have "
                "no confidence."
            )

    def requires(self, key: str) -> Iterator[Requirement]:
        """Yield the requirements that follow from the settings of the domain at `key`."""
        for name, value in (("view", self.view), ("head", self.head)):
            if value is not None:
                setting = f"{key}.{name}={value}"
                yield Requirement("scheme", "shows_views", True, setting)
                yield Requirement("model", f"{name}s", (value,), setting)
        if self.teacher_view is not None:
            setting = f"{key}.teacher_view={self.teacher_view}"
            yield Requirement(f"network of {key}.labels", "views", (self.teacher_view,), setting)
        if self.confidence:
            yield Requirement("loss", "weighs_confidence", True, f"{key}.confidence=true")


@dataclass(frozen=True, kw_only=True)
class Domains:
    """The domains of a run, and which head predicts which image in evaluation.

    conf/domains/one.yaml describes each setting. The target is that of its view (RGB to thermal) or
    of the night (day to night). InputError: heads that cannot be distinguished.
    """

    source: Domain
    target: Domain | None
    target_is: Literal["view", "night"] | None
    tested_head: Literal["own", "source"]

    def __post_init__(self) -> None:
        if self.source.labels == NONE:
            raise InputError(
                "domains.source.labels=none, but every scheme requires labels of the source."
            )
        heads, target = self.heads, self.target
        if target is not None and (self.source.head is None) != (target.head is None):
            raise InputError(
                "domains: source and target must both have a head, or neither; got "
                f"{self.source.head or 'null'} and {target.head or 'null'}."
            )
        is_two, selects = len(heads) == 2, self.tested_head == "source"
        if (self.target_is is not None) != is_two or (selects and not is_two):
            raise InputError(
                f"domains.target_is={self.target_is or 'null'} and domains.tested_head="
                f"{self.tested_head} with {len(heads)} heads: both select one of two heads."
            )
        if self.target_is == "view" and self.named["target"].view in (None, self.source.view):
            raise InputError(
                "domains.target_is=view selects the head of an image by its view, but both "
                f"domains have the view {self.source.view or 'null'}; set domains.target_is=night, "
                "or another domains.target.view."
            )

    @property
    def record(self) -> DomainsRecord:
        """State what the domains provide, and what they require of other components."""
        requires: list[Requirement] = []
        if self.target is not None:
            requires.append(Requirement("scheme", "num_domains", 2))
        for name, domain in self.named.items():
            requires += domain.requires(f"domains.{name}")
        return DomainsRecord(
            requires=tuple(requires),
            num_domains=1 if self.target is None else 2,
            heads=self.heads,
            separate_heads=len(self.heads) > 1,
            target_labels=self.target is not None and self.target.labels != NONE,
            target_confidence=self.target is not None and self.target.confidence,
        )

    @cached_property
    def named(self) -> dict[str, Domain]:
        """Return the domains by name: "source" and, where there is one, "target"."""
        both = {"source": self.source, "target": self.target}
        return {name: domain for name, domain in both.items() if domain is not None}

    @property
    def heads(self) -> tuple[str, ...]:
        """Return the names of the heads, the source's first; () if there is one for all."""
        heads = (domain.head for domain in self.named.values())
        return tuple(dict.fromkeys(head for head in heads if head is not None))

    def heads_in_words(self, choice: TestedHead) -> str:
        """Say which head predicts which images, for messages; "" if there is one for all."""
        if len(self.heads) < 2:
            return ""
        source, target = self.heads
        if choice != "own":
            return f"{self.named[choice].head} for all images"
        if self.target_is == "night":
            return f"{source} by day, {target} at night"
        return f"{target} for {self.named['target'].view}, {source} otherwise"

    def head_of(self, view: View, night: bool | None, choice: TestedHead) -> str | None:
        """Return the head that predicts an image; None if the network has one head for all.

        Args:
            view: the images that the network gets.
            night: whether it was taken at night; None if the data set does not state it.
            choice: "own", or the domain of the head that predicts all images.

        Raises:
            InputError: `choice` of one head only; or the time of day decides, and is unknown.
        """
        heads = self.heads
        if len(heads) < 2:
            if choice != "own":
                raise InputError(
                    f"head={choice} selects one of two heads, but the network of this run has one "
                    "head for all images; omit head=."
                )
            return heads[0] if heads else None
        if choice == "own" and self.target_is == "view":
            choice = "target" if view == self.named["target"].view else "source"
        elif choice == "own":
            if night is None:
                raise InputError(
                    "domains.target_is=night: the data set does not state which images were taken "
                    "at night, so no head can be selected. Set head=source or head=target."
                )
            choice = "target" if night else "source"
        return self.named[choice].head
