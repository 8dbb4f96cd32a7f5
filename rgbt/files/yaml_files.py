"""Read YAML of others as plain data, with the values that OmegaConf reads (``1e-3``: a number).

Objects and interpolations are handled in `rgbt.config.stored_config`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from omegaconf._utils import get_yaml_loader  # private: its rules for numbers are those of Hydra

from rgbt.checks import InputError, one_line
from rgbt.files.budgets import read_bytes

MOST_BYTES, DEEPEST = 1_000_000, 50  # the largest file of this project has 16 kB and 7 levels


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The C reader where there is one (20 times as fast), with OmegaConf's rules for scalars."""

    yaml_implicit_resolvers = get_yaml_loader().yaml_implicit_resolvers

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        found: dict[Any, Any] = super().construct_mapping(node, deep)
        if len(found) < len(node.value):
            keys = [str(key.value) for key, _ in node.value]
            raise _error(f"duplicate key {max(keys, key=keys.count)!a}", node)
        return found


def read_yaml(path: Path) -> Any:
    """The content of a file; InputError as of `parse_yaml`, or if it is no readable file."""
    try:
        return parse_yaml(read_bytes(path).decode(), str(path))
    except FileNotFoundError:
        raise InputError(f"the file {path} does not exist.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as YAML: {error}.") from error


def parse_yaml(text: str, source: str) -> Any:
    """Plain values (dict, list, str, int, float, bool, None) of a text from `source`.

    InputError: not one document without anchors, aliases and tags, or above the limits.
    """
    try:
        _check_events(text)
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        reason = " ".join(part for part in (error.context, error.problem) if part)
        raise InputError(f"{source}, line {mark.line + 1}: {one_line(reason)}.") from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: an integer of 5,000 digits
        raise InputError(f"{source} cannot be read as YAML: {one_line(error)}.") from error


def _check_events(text: str) -> None:
    # The reader of nodes descends recursively, and crashes on a list of 60,000 brackets.
    if len(text) > MOST_BYTES:
        raise ValueError(f"it is larger than {MOST_BYTES:,} bytes")
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise _error("anchors and aliases (& and *) are not supported; repeat the value", event)
        if getattr(event, "tag", None) is not None:
            raise _error(f"the tag {event.tag!a} is not supported; remove it", event)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise _error(f"it has more than {DEEPEST} levels", event)


def _error(reason: str, where: yaml.Node | yaml.Event) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, reason, where.start_mark)
