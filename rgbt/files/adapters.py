"""Find the adapters of external networks: Python files beside their recipes."""

from __future__ import annotations

import os
from pathlib import Path

GROUP = Path("model", "external")


def adapter_of(constructor: str) -> Path | None:
    """The adapter that "adapters.py:gmnet" names; None where it names a module of the checkout.

    It lies in ``conf/model/external/``, or in such a folder of the user's own (``RGBT_CONF``), and
    never elsewhere, so that a stored configuration cannot name another file. FileNotFoundError:
    there is none.
    """
    name = constructor.partition(":")[0]
    if not name.endswith(".py"):
        return None
    package = Path(__file__).resolve().parents[1]
    own = filter(None, os.environ.get("RGBT_CONF", "").split(","))
    folders = [package / "conf", package.parent / "conf"]
    folders += [Path(word.strip().removeprefix("file://")).expanduser() for word in own]
    for folder in folders:
        if name == Path(name).name and (folder / GROUP / name).is_file():
            return folder / GROUP / name
    raise FileNotFoundError(f"no adapter {name} beside a recipe in {GROUP}")
