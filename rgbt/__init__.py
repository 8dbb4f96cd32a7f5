"""A lab for RGB-thermal semantic segmentation of driving scenes.

``python -m rgbt.run +experiment=grbm`` trains; `rgbt.load_run` and `rgbt.results` read what was
trained. Importing this package imports nothing else until one of these names is used. It sets how
long threads of OpenMP wait in a loop, which torch reads when it is imported.
"""

import os
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"  # read by the build (`tool.hatch.version`); CITATION.cff repeats it

if TYPE_CHECKING:
    from rgbt.api import Run, load_run

__all__ = ["Run", "load_run", "results"]

# A thread that waits in a loop takes the core of the thread that it waits for, wherever another
# program uses a core too: a step then takes 5 to 35 times as long. `rgbt.cores` says why
# these values; children inherit them.
WAITING = {"GOMP_SPINCOUNT": "5000", "KMP_BLOCKTIME": "1"}  # GNU's OpenMP; Intel's and LLVM's
if not {*WAITING, "OMP_WAIT_POLICY"} & os.environ.keys():
    os.environ.update(WAITING)

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
