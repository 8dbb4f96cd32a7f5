"""Digest the code of an author's checkout that a run executes (`rgbt.models.external`).

The digest replaces the path of the checkout in the run key. It covers the module of the
constructor and everything in the checkout that this imports, also inside functions; nothing is
imported for it. Installed packages do not count.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rgbt.config.stored_config import EXTERNAL
from rgbt.spec.source_code import Used, modules_from

PREFIX = "checkout/"
"""Before the names of the modules of a checkout, which may be those of the user's own."""


def checkout_code(model: Mapping[str, Any]) -> tuple[Used, ...]:
    """Modules of the checkout that a network executes, with the digest of their code, by name.

    Args:
        model: plain values of the node.

    Returns:
        () where the network is no other author's, or the folder does not exist.
    """
    if model.get("_target_") != EXTERNAL:
        return ()
    root = Path(str(model.get("checkout"))).expanduser() / str(model.get("root"))
    empty = set(model.get("empty_packages", ()))

    def file_of(name: str) -> Path | None:
        place = root.joinpath(*name.split("."))
        files = (place / "__init__.py", place.with_name(f"{place.name}.py"))
        return None if name in empty else next((each for each in files if each.is_file()), None)

    module = str(model.get("constructor")).partition(":")[0]
    return tuple(sorted((PREFIX + name, code) for name, code in modules_from(module, file_of)))
