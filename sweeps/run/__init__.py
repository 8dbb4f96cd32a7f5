"""Execution of points: the driver of a study, executors, jobs, finished runs."""
