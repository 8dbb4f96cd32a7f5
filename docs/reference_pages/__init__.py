"""Pages of the site that are made from the code and from data at build time.

`docs/hook.py` adds them to the site; nothing here is written to the repository.
"""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def generated_pages() -> dict[str, str]:
    """Text of every generated page, by its path in docs/."""
    from reference_pages import (
        commands,
        configuration,
        experiments,
        external,
        recipes,
        tables,
        weights,
    )

    return {
        **configuration.pages(),
        "reference/experiments.md": experiments.experiments_page(),
        "reference/recipes.md": recipes.recipes_page(),
        "reference/commands.md": commands.commands_page(),
        "reference/external-networks.md": external.external_page(),
        "reference/tables.md": tables.tables_page(),
        "reference/weights.md": weights.weights_page(),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(),
    }
