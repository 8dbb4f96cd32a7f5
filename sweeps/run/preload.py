"""Imported by the fork server alone: the modules of rgbt, and a record of the code of all of them.

The runs then execute, and record, the code of this moment, even if files are edited meanwhile.
"""

import gc
import importlib
import pkgutil

import rgbt
from rgbt.config.compose import compose
from rgbt.runs.provenance import code, packages
from rgbt.runs.source_code import loaded_modules, user_code

# Modules that are not imported: runs execute them as programs, or do not use them.
PROGRAMS = ("rgbt.run", "rgbt.evaluate", "rgbt.consistency", "rgbt.api")

LIBRARIES = (
    "torch",
    "hydra",
    "scipy.optimize",
    "sweeps.run.local",
    "mlflow",
    "mlflow.store.tracking.sqlalchemy_store",
)

gc.disable()  # nothing that is imported here is garbage
for _library in LIBRARIES:
    importlib.import_module(_library)
for _module in pkgutil.walk_packages(rgbt.__path__, "rgbt."):
    if _module.name not in PROGRAMS and not _module.name.endswith("__main__"):
        importlib.import_module(_module.name)
code()
packages()
user_code(f"{name}.any" for name in loaded_modules())
compose(["+experiment=grbm"])  # Hydra keeps its plugins and its grammar
gc.freeze()  # nor need the collector of a run visit it
gc.enable()
