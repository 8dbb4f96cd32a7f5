"""The training loop and what it needs: optimizers, schedules, checkpoints, evaluation, progress.

Nothing here knows a network, a loss or a data set: they arrive as objects.
"""
