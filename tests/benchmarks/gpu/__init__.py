"""Everything that only a GPU can show about this project, measured by one command.

``python -m tests.benchmarks.gpu out=FOLDER minutes=8`` runs the steps of `steps.STEPS` in order,
each in a process of its own with a time limit. After each step it writes ``results.json`` and
``results.md``; a step that fails, hangs or runs out of memory costs that step alone.

`__main__`, `request`, `steps`, `runner`, `processes` and `report` need the standard library only.
The modules `step_*` measure.
"""
