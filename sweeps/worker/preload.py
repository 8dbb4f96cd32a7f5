"""Imported last by the process that all runs of a sweep are forked from: records its code.

The runs then have the digests of the code that they execute, even if files are edited meanwhile.
"""

from rgbt.runs.provenance import code, packages
from rgbt.runs.source_code import loaded_modules, user_code


def record_code() -> None:
    """Keep the digests of all modules imported until now, and the versions of packages."""
    code()
    packages()
    user_code(f"{module}.any" for module in loaded_modules())


record_code()
