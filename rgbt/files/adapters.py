"""Find the adapters of external networks: ours, and a user's Python files beside their recipes."""

from __future__ import annotations

import os
from pathlib import Path

GROUP = Path("model", "external")
OURS = Path(__file__).resolve().parents[1] / "models" / "external"


def adapter_of(constructor: str) -> Path | None:
    """Return the file that "adapters.py:gmnet" names; None: it names a module of the checkout.

    ``adapters.py`` and ``adapters_2026.py`` are ours. Others lie in the folder ``model/external/``
    of the user's own configuration (``RGBT_CONF``), and never elsewhere, so that a stored
    configuration cannot name another file. FileNotFoundError: there is none.
    """
    name = constructor.partition(":")[0]
    if not name.endswith(".py"):
        return None
    if name in ("adapters.py", "adapters_2026.py"):
        return OURS / name
    for folder in filter(None, os.environ.get("RGBT_CONF", "").split(",")):
        file = Path(folder.strip().removeprefix("file://")).expanduser() / GROUP / name
        if name == Path(name).name and file.is_file():
            return file
    raise FileNotFoundError(f"no adapter {name} beside a recipe in {GROUP}")
