"""Tables, grids and searches: what is missing of them is run, each point in a process of its own.

``python -m sweeps.reproduce table=spatialseg/table3`` and ``python -m rgbt.run -m ...`` stand on
one mechanism: points in an Optuna study (`trial_store`), worked off by any number of drivers (`driver`).
"""
