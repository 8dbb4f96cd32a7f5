"""The training loop with optimizers, schedules, checkpoints, evaluation and progress.

Networks, losses and data sets are passed in as objects.
"""
