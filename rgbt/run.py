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
    from hydra.core.hydra_config import HydraConfig

    from rgbt.config.command import words_of_run
    from rgbt.spec.naming import tags_from_environment
    from rgbt.spec.request import note_request
    from rgbt.spec.specify import specify
    from rgbt.spec.unused import unused_sentences
    from rgbt.tracking.terminal import warn
    from rgbt.training.show import is_launched, report_pretrained, show_known
    from rgbt.training.start import start

    overrides, tags = list(HydraConfig.get().overrides.task), tags_from_environment()
    for sentence in () if is_launched() else unused_sentences(config, overrides):
        warn(sentence)
    if show_known(config, overrides, tags):
        return 0
    # torch is imported from here on, after --help and after finished runs
    run = specify(config, overrides)
    report_pretrained(run.pretrained, run.uses_pretrained, run.name)
    code = start(run, tags, words_of_run())
    if run.is_finished and not is_launched():
        note_request(config, run)
    return code


if __name__ == "__main__":
    main()
