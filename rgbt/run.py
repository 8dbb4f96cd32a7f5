"""Train one configuration: ``python -m rgbt.run +experiment=grbm``.

The same command resumes an unfinished run; for a finished run it prints the tables.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rgbt.config.command import command

if TYPE_CHECKING:
    from omegaconf import DictConfig


@command(sweeper="study")
def main(config: DictConfig) -> int:
    """Train the upstream runs and the run, evaluate its checkpoint on the test split."""
    # torch is imported here, after --help
    from hydra.core.hydra_config import HydraConfig

    from rgbt.config.command import words_of_run
    from rgbt.spec.naming import tags_from_environment
    from rgbt.spec.specify import specify
    from rgbt.tracking.terminal import info
    from rgbt.training.start import start

    run = specify(config, list(HydraConfig.get().overrides.task))
    if run.pretrained is not None and not run.uses_pretrained:
        info(
            f"pretrained={run.pretrained} is ignored: the experiment {run.name} does not use "
            "ImageNet weights."
        )
    return start(run, tags_from_environment(), words_of_run())


if __name__ == "__main__":
    main()
