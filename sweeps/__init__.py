"""Tables, grids and searches: unfinished runs are executed, each in a process of its own.

``python -m sweeps.reproduce table=spatialseg/table3`` and ``python -m rgbt.run -m ...`` share one
mechanism: trials of an Optuna study (`worker.trial_store`), executed by any number of drivers
(`worker.driver`).
"""
