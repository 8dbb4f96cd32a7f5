"""A step that needs a package that nobody has."""

from typing import Any


def measure(task: Any) -> None:
    import no_such_package_of_anybody  # noqa: F401
