"""A lab for RGB-thermal semantic segmentation of driving scenes.

``python -m rgbt.run +experiment=grbm`` trains; `rgbt.load_run` and `rgbt.results` read what was
trained. Importing this package imports nothing else until one of these names is used.
"""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"  # read by the build (`tool.hatch.version`); CITATION.cff repeats it

if TYPE_CHECKING:
    from rgbt.api import Run, load_run

__all__ = ["Run", "load_run", "results"]

# Named, not imported, as the commands are: nothing in rgbt imports the analysis.
_MODULES = {"Run": "rgbt.api", "load_run": "rgbt.api", "results": "analysis.results"}


def __getattr__(name: str) -> Any:
    """The names of `_MODULES`, imported at their first use (PEP 562)."""
    if name in _MODULES:
        from importlib import import_module

        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
