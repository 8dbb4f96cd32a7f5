"""Train one configuration: ``python -m rgbt.run +experiment=grbm``.

The same command on the same configuration continues its run folder; a finished run shows its
tables and stops.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rgbt.config.command import command, task_overrides

if TYPE_CHECKING:
    from omegaconf import DictConfig


@command(sweeper="study")
def main(config: DictConfig) -> int:
    """Train, evaluate a checkpoint on the test split, show the tables; earlier runs come first."""
    # torch loads here, after --help
    from rgbt.build.training_setup import rehearse
    from rgbt.tracking.terminal import tell
    from rgbt.training.pipeline import (
        earlier_runs,
        finish_earlier,
        reads_pretrained,
        warn_of_other_code,
    )
    from rgbt.training.train import is_finished, train

    if config.pretrained is not None and not reads_pretrained(config):
        tell(f"pretrained={config.pretrained} is not read: {config.name} starts otherwise.")
    # A key may hash a large file of weights: it is asked for only where it decides something.
    needed = list(earlier_runs(config))
    if needed and config.fresh:
        warn_of_other_code(needed)
    if needed and (config.fresh or not is_finished(config)):
        finish_earlier(config, train, rehearse, task_overrides())
    train(config, task_overrides())
    return 0


if __name__ == "__main__":
    main()
