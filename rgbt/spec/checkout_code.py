"""Digest the code of an author's checkout that a run executes (`rgbt.models.external`).

The digest replaces the path of the checkout in the run key. It covers the module of the
constructor and everything in the checkout that this imports, also inside functions; nothing is
imported for it. Installed packages do not count.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.config.stored_config import EXTERNAL, targets
from rgbt.spec.source_code import Used, modules_from, user_code

PREFIX = "checkout/"
"""Before the names of the modules of a checkout, which may be those of the user's own."""


def checkout_code(model: Mapping[str, Any]) -> tuple[Used, ...]:
    """Modules of the checkout that a network executes, with the digest of their code, by name.

    Args:
        model: plain values of the node.

    Returns:
        () where the network is no other author's, or the checkout does not have its module.
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
    if file_of(module) is None:
        return ()
    return tuple(sorted((PREFIX + name, code) for name, code in modules_from(module, file_of)))


def code_of(plain: Mapping[str, Any]) -> dict[str, str]:
    """The user's own code and that of a checkout in a configuration: digest by module.

    Args:
        plain: the whole configuration as resolved values.
    """
    return dict((*user_code(targets(plain).values()), *checkout_code(plain["model"])))


def content_of(model: Mapping[str, Any]) -> dict[str, str]:
    """What stands for the path of the checkout in the run key: `checkout_code` by module.

    Raises:
        InputError: the checkout does not have the module of the constructor.
    """
    found = dict(checkout_code(model))
    if not found:
        raise InputError(
            f"model.checkout={model.get('checkout')}: expected a folder that has the module of "
            f"model.constructor={model.get('constructor')} in model.root={model.get('root')}; name "
            "the folder of the author's repository."
        )
    return found
