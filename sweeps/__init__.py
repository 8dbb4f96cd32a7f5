"""Many runs: grids, searches and tables, with the claims of papers and the pages made of them.

The rooms are read in one order, and each imports those before it only: `plan` (what was asked, as
points with keys and tags), `run` (one driver a study, executors), `score` (columns, measurements,
cells), `judge` (verdicts), `show` (terminal, pages). The modules beside them are commands.
"""
