"""How the run key and the upstream runs use each node of the configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Node:
    """How the run key and the upstream runs use a node of the configuration.

    Attributes:
        in_key: whether it is part of the run key.
        outside_key: settings of it that are not: paths, hardware, labels, and what other settings
            take up.
        added: settings that are newer than the first runs -> what these runs did: left out of the
            key where they say that, so that a run keeps its key.
        used_with: settings that have an effect only where another setting has a value -> that
            setting and value; left out of the key elsewhere.
        renamed: settings of which values have another name now -> the present name -> the name
            that the key keeps, and that stored configurations may have.
        added_as: the same as `added` for the whole node; None: it is as old as the first runs.
        shared: whether upstream runs take it over from the run that needs them; or which of its
            settings.
    """

    in_key: bool = True
    outside_key: tuple[str, ...] = ()
    added: Mapping[str, Any] = field(default_factory=dict)
    used_with: Mapping[str, tuple[str, Any]] = field(default_factory=dict)
    renamed: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    added_as: Mapping[str, Any] | None = None
    shared: bool | tuple[str, ...] = False

    def key_settings(self, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """The part of a node's canonical `values` that enters the run key, below its `name`."""
        if not self.in_key or values == self.added_as:
            return {}
        old = [key for key, value in self.added.items() if values.get(key) == value]
        unused = [key for key, (other, v) in self.used_with.items() if values.get(other) != v]
        left_out = {*self.outside_key, *old, *unused}
        names = {
            key: self.renamed[key].get(value, value)
            for key, value in values.items()
            if key in self.renamed and isinstance(value, str)
        }
        values = {**values, **names}
        return {name: {key: values[key] for key in values if key not in left_out}}


def node_field(**policy: Any) -> Any:
    """A field of a dataclass that is a node with this policy, in its metadata as "node"."""
    return field(metadata={"node": Node(**policy)})
