"""Compare the records (`rgbt.requirements`) of a run's components before the run starts."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from omegaconf import DictConfig

from rgbt.checks import InputError
from rgbt.config.component import Component, constructor
from rgbt.config.compose import choices
from rgbt.requirements import Record, Requirement, record_of

MOST_CHOICES = 6
"""Names that a message lists of one group."""


WITHOUT_RECORD = {"loss": Record(requires=(Requirement("model", "outputs", "scores"),))}
"""Record of a component that states none, where it is not the general one, by node.

A user's loss that reads the class scores of a network without any would end in a traceback.
"""

Failure = tuple[str, Requirement]
"""A requirement that is not met, after the key of the component that has it."""

Candidate = tuple[str, str, Record]
"""Group and name of a file of ``conf/`` that could be chosen, the record of what it describes."""


def check_requirements(components: Mapping[str, Any], plain: Mapping[str, Any]) -> None:
    """Refuse components of which one lacks what another one requires.

    Args:
        components: by their keys in the configuration ("model", "loss"), in the order in which
            their requirements are looked at.
        plain: the whole configuration as resolved values, for the files that could be chosen.

    Raises:
        InputError: the first requirement that is not met, with the files of ``conf/`` that help.
    """
    records = {node: _record(node, component) for node, component in components.items()}
    failures = list(_failures(records))
    if not failures:
        return
    node, wanted = failures[0]
    both = {key: records[key] for key in (node, wanted.node)}
    candidates = list(_candidates((wanted.node, node), components, plain))
    # Where no single file helps with everything, those that help with this.
    options = _options(failures, records, candidates) or _options(failures[:1], both, candidates)
    advice = [wanted.advice] if wanted.advice else []
    advice += [f"choose {', or '.join(options)}"] if options else []
    advice += [f"change {wanted.setting.partition('=')[0]}"] if wanted.setting else []
    subject = _name(components[node]) + (f" with {wanted.setting}" if wanted.setting else "")
    provided = records[wanted.node].get(wanted.key)
    raise InputError(
        f"{subject} requires {wanted.key}={_shown(wanted.value)} of the {wanted.node}, but "
        f"{_name(components[wanted.node])} provides {wanted.key}={_shown(provided)}; "
        f"{', or '.join(advice) or f'change {node} or {wanted.node}'}."
    )


def _record(node: str, component: Any) -> Record:
    record = record_of(component)
    return record if hasattr(component, "record") else WITHOUT_RECORD.get(node, record)


def _failures(records: Mapping[str, Record]) -> Iterator[Failure]:
    for node, record in records.items():
        for requirement in record.requires:
            other = records.get(requirement.node)
            if other is not None and not requirement.is_met_by(other):
                yield node, requirement


def _candidates(
    groups: Iterable[str], components: Mapping[str, Any], plain: Mapping[str, Any]
) -> Iterator[Candidate]:
    # A data set is no choice: to build one may write its images.
    for group in (each for each in groups if each in plain and each != "dataset"):
        for name, node in choices(plain, group):
            record = _record_of_file(node, group, components)
            if record is not None:
                yield group, name, record


def _options(
    failures: list[Failure], records: Mapping[str, Record], candidates: list[Candidate]
) -> list[str]:
    """Files with which the first failure is gone and fewest remain, by group."""
    left = [(g, name, set(_failures({**records, g: record}))) for g, name, record in candidates]
    helping = [(g, name, len(rest)) for g, name, rest in left if rest <= set(failures[1:])]
    fewest = min((number for *_, number in helping), default=0)
    names: dict[str, list[str]] = {}
    for group, name, number in helping:
        if number == fewest:
            names.setdefault(group, []).append(name)
    return [
        f"{group}={', '.join(each[:MOST_CHOICES])}{', ...' if len(each) > MOST_CHOICES else ''}"
        for group, each in names.items()
    ]


def _record_of_file(node: DictConfig, group: str, components: Mapping[str, Any]) -> Record | None:
    """The record of what a node describes; None where that cannot be built here."""
    try:
        target = constructor(node["_target_"], group)
        declared = inspect.getattr_static(target, "record", None)
        if isinstance(declared, Record):
            return declared
        described = Component.from_node(node)
        if hasattr(target, "record_from"):
            record: Record = target.record_from(**described.values)
            return record
        others = {key: each for key, each in components.items() if key not in described.values}
        # A network takes no memory there; a view is checked by numbers that it has elsewhere alone.
        with torch.device("meta" if group == "model" else "cpu"):
            return record_of(described.build(**others))
    except Exception:  # noqa: BLE001 - a file may miss values, or be a user's: it is no choice
        return None


def _name(component: Any) -> str:
    is_callable = inspect.isfunction(component) or inspect.isclass(component)
    return str(component.__name__) if is_callable else type(component).__name__


def _shown(value: Any) -> str:
    """A value as it is written in a configuration."""
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
