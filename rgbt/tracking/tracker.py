"""What a run reports to its tracker (`rgbt.tracking.mlflow_store` has the ones to choose from)."""

from __future__ import annotations

from typing import Literal

from rgbt.tracking.run_files import Description
from rgbt.tracking.run_folder import RunFolder

Status = Literal["RUNNING", "FINISHED", "FAILED", "KILLED"]

Link = tuple[str, str]
"""(name, command or address), for the last lines of a run."""


class Tracking:
    """Shows runs to people; this one keeps the run folder alone.

    No call raises because a store cannot be reached.
    """

    def start(self, folder: RunFolder, description: Description) -> None:
        """Begin, or continue, the run of `folder`."""
        folder.describe(description)

    def update(self) -> None:
        """Show what is new in the folder; called after every evaluation."""

    def finish(self, status: Status) -> None:
        """End the run: it is finished, failed or was stopped (killed)."""

    def links(self) -> list[Link]:
        """Where a person looks at the run."""
        return []
