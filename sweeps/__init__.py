"""Tables, grids and searches: unfinished runs are executed, each in a separate process.

``rgbt reproduce table=spatialseg/table3`` and ``rgbt run -m ...`` use one mechanism: trials of an
Optuna study (`worker.trial_store`), executed by any number of drivers (`worker.driver`).
"""
