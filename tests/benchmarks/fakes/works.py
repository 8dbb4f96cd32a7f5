"""A step that measures something."""

from typing import Any


def measure(task: Any) -> None:
    for name in task.as_time_allows(["one", "two"], first=0.1):
        task.row(name=name, value=1.23456, device=task.device)
    task.note("A sentence.")
    task.headline("two parts")
