"""Read YAML from untrusted sources as plain data within a budget.

Objects and interpolations are handled in `rgbt.config.stored_config`. The values
are those that OmegaConf reads (``1e-3`` is a number, a repeated key is an error).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import yaml
from omegaconf._utils import get_yaml_loader  # private: its rules for numbers are those of Hydra

from rgbt.checks import InputError, one_line

MOST_BYTES = 1_000_000
MOST_NODES = 10_000
DEEPEST = 50
LONGEST = 10_000
"""Budget of one file: size, mappings + lists + values, nesting, characters of a value. The largest
file of this project has 16 kB, 1,200 nodes and 7 levels."""

INTEGER_BITS = 64


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The C reader where there is one (20 times as fast), with OmegaConf's rules for scalars."""

    yaml_implicit_resolvers = get_yaml_loader().yaml_implicit_resolvers

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        found: dict[Any, Any] = super().construct_mapping(node, deep)
        if len(found) < len(node.value):
            repeated, _ = Counter(str(key.value) for key, _ in node.value).most_common(1)[0]
            raise _error(f"duplicate key {ascii(repeated)}", node)
        return found

    def _integer(self, node: yaml.Node) -> int:
        found: int = self.construct_yaml_int(node)
        if found.bit_length() > INTEGER_BITS:
            raise _error(f"an integer of more than {INTEGER_BITS} bits", node)
        return found


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader._integer)


def read_yaml(path: Path) -> Any:
    """The content of a file.

    Raises:
        InputError: see `parse_yaml`; or the file is missing, not a regular file, or too large.
    """
    if not path.is_file():
        raise InputError(f"the file {path} does not exist.")
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
        return parse_yaml(content.decode(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as YAML: {error}.") from error


def parse_yaml(text: str, source: str) -> Any:
    """Plain values of a YAML text: dict, list, str, int, float, bool, None.

    Args:
        text: one document without anchors, aliases and tags.
        source: where it comes from, for messages.

    Raises:
        InputError: the text is not such a document, or exceeds the budget (see `MOST_BYTES`).
    """
    try:
        # First the events alone: the reader of nodes descends recursively, and crashes the process
        # on a list of 60,000 brackets.
        _check_budget(text, source)
        return yaml.load(text, _Loader)
    except InputError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        reason = " ".join(part for part in (error.context, error.problem) if part)
        raise InputError(
            f"{source} cannot be read as YAML: line {mark.line + 1}: {reason}."
        ) from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: an integer of 5,000 digits
        raise InputError(f"{source} cannot be read as YAML: {one_line(error)}.") from error


def _error(reason: str, node: yaml.Node) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, reason, node.start_mark)


def _check_budget(text: str, source: str) -> None:
    if len(text) > MOST_BYTES:
        raise InputError(f"{source} is larger than the limit of {MOST_BYTES:,} bytes.")
    nodes = depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            reason = "anchors and aliases (& and *) are not supported; repeat the value"
            raise _refused(source, event, reason)
        if getattr(event, "tag", None) is not None:
            raise _refused(source, event, f"the tag {ascii(event.tag)} is not supported; remove it")
        nodes += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if nodes > MOST_NODES or depth > DEEPEST:
            limits = f"{MOST_NODES:,} values and {DEEPEST} levels"
            raise _refused(source, event, f"it exceeds the limit of {limits}")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST:
            reason = f"a value exceeds the limit of {LONGEST:,} characters"
            raise _refused(source, event, reason)


def _refused(source: str, event: yaml.Event, reason: str) -> InputError:
    return InputError(f"{source}, line {event.start_mark.line + 1}: {reason}.")
