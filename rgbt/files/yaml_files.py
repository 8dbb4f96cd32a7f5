"""Read YAML of others as plain data, with the values that OmegaConf reads (``1e-3``: a number).

Objects and interpolations are handled in `rgbt.config.stored_config`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from omegaconf._utils import get_yaml_loader  # private: its rules for numbers are those of Hydra

from rgbt.checks import InputError, one_line
from rgbt.files.plain_files import check_seal, read_bytes

# Tags whose values are plain; every other one is refused.
PLAIN = ("null", "bool", "int", "float", "str", "seq", "map")

# Characters of a number: Python raises for longer ones at many places, or takes minutes.
NUMBER_LENGTH = 100
# Levels of mappings and lists inside each other; readers of the values call themselves for each.
MAX_DEPTH = 50


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The C reader where there is one (20 times as fast), with OmegaConf's rules for scalars."""

    yaml_implicit_resolvers = get_yaml_loader().yaml_implicit_resolvers
    yaml_constructors = {  # noqa: RUF012
        tag: construct
        for tag, construct in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.rpartition(":")[2] in PLAIN
    }

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        # A kilobyte of aliases of aliases stands for more values than a computer has memory.
        if node in self.constructed_objects:
            raise _refused("found an alias (*name) of this value; write the value again", node)
        is_number = node.tag.endswith((":int", ":float"))
        if is_number and len(node.value) > NUMBER_LENGTH:
            raise _refused(f"found a number of {len(node.value)} characters", node)
        return super().construct_object(node, deep)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge nothing: a key ``<<`` has no plain value, and is refused."""

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Any, Any]:
        found: dict[Any, Any] = super().construct_mapping(node, deep)
        if len(found) < len(node.value):
            keys = Counter(str(key.value) for key, _ in node.value)
            raise _refused(f"duplicate key {keys.most_common(1)[0][0]!a}", node)
        return found


def _refused(reason: str, node: yaml.Node) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, reason, node.start_mark)


def read_yaml(path: Path) -> Any:
    """Read a file; InputError as of `parse_yaml`, or if it is no readable file."""
    try:
        content = read_bytes(path)
        check_seal(content)
        return parse_yaml(content.decode(), str(path))
    except FileNotFoundError:
        raise InputError(f"the file {path} does not exist.") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as YAML: {error}.") from error


def parse_yaml(text: str, source: str) -> Any:
    """Read plain values (dict, list, str, int, float, bool, None) of a text from `source`.

    InputError: not one document, a duplicate key, an alias, or a tag of another value.
    """
    try:
        content = yaml.load(text, _Loader)
        level, depth = [content], 0
        while level := [value for node in level for value in _inside(node)]:
            if (depth := depth + 1) > MAX_DEPTH:
                raise ValueError(f"it has more than {MAX_DEPTH} levels")
        return content
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        reason = " ".join(part for part in (error.context, error.problem) if part)
        raise InputError(f"{source}, line {mark.line + 1}: {one_line(reason)}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{source} cannot be read as YAML: {one_line(error)}.") from error


def _inside(node: Any) -> Iterable[Any]:
    return node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
