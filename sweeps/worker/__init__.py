"""Execution of trials: studies, drivers, processes, finished runs."""
