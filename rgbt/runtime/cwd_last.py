"""Imported first by the fork server of a sweep: the working directory is searched last there.

A user's folder may hold packages called `sweeps` or `analysis`; the command `rgbt` does the same.
"""

import sys

if sys.path[0] == "":
    sys.path.append(sys.path.pop(0))
