"""Track no run: only its folder is written. `rgbt.tracking.mlflow_store` shows runs in MLflow."""

from __future__ import annotations

from typing import Literal

from rgbt.runs.folder import Description, RunFolder

Status = Literal["RUNNING", "FINISHED", "FAILED", "KILLED"]

# (name, command or address), for the last lines of a run.
Link = tuple[str, str]


class Tracking:
    """Describes the run in its folder, which `rgbt sync` can send later (``tracking=none``).

    It is also the base of other trackers; no call raises for a store that is away.
    """

    def start(self, folder: RunFolder, description: Description) -> None:
        """Start or continue the run of `folder`; no step has been done yet by this process."""
        folder.describe(description)

    def after_step(self) -> None:
        """Called after every step of a training; a store that starts slowly can start here."""

    def update(self) -> None:
        """Send new data of the folder; called after every evaluation."""

    def finish(self, status: Status) -> None:
        """Close the run as finished, failed or stopped (killed)."""

    def refresh(self, folder: RunFolder, description: Description) -> None:
        """Show the finished run of `folder` under `description`; a store may have it already."""
        self.start(folder, description)
        self.finish("FINISHED")

    def links(self) -> list[Link]:
        """Return the command that shows the run, one line."""
        return []
