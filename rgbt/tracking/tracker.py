"""What a run reports to its tracker, whichever it is (`rgbt.tracking.mlflow_store` has them)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Protocol

from rgbt.tracking.run_folder import RunFolder

Status = Literal["RUNNING", "FINISHED", "FAILED", "KILLED"]

Link = tuple[str, str]
"""(name, command or address), for the last lines of a run."""


class Tracking(Protocol):
    """Shows runs to people. No call raises because a store cannot be reached."""

    def start(
        self,
        folder: RunFolder,
        run_name: str,
        tags: Mapping[str, str],
        params: Mapping[str, object],
    ) -> None:
        """Begin, or continue, the run of `folder`."""
        ...

    def update(self) -> None:
        """Show what is new in the folder; called after every evaluation."""
        ...

    def finish(self, status: Status) -> None:
        """End the run: it is finished, failed or was stopped (killed)."""
        ...

    def links(self) -> list[Link]:
        """Where a person looks at the run."""
        ...
