"""The specification of a finished run with what a user changes of it."""

from __future__ import annotations

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.config.compose import compose, conf_dir
from rgbt.spec import load_spec


def resolved(*overrides: str) -> DictConfig:
    """A configuration as a run stores it."""
    config = OmegaConf.create(OmegaConf.to_container(compose(overrides), resolve=True))
    assert isinstance(config, DictConfig)
    return config


OTHER = ("dataset=synth_kp", "dataset.absent=exclude")


@pytest.mark.parametrize(
    ("trained", "words", "expected"),
    [
        ((), (), "released"),
        # Another data set has its own convention; another partition changes none.
        ((), OTHER, "exclude"),
        (("dataset.absent=exclude",), ("dataset=synth_kp",), "released"),
        (("dataset.absent=exclude",), ("metric=ring9",), "exclude"),
        # Set by hand, in the run or in the command that evaluates it.
        (("metric.absent=exclude",), ("dataset=synth_kp",), "exclude"),
        ((), ("metric=ring9", "metric.absent=exclude"), "exclude"),
    ],
)
def test_override_absent_classes_follow_the_evaluated_data_set(
    trained: tuple[str, ...], words: tuple[str, ...], expected: str
) -> None:
    config = resolved(*trained)
    load_spec._override(config, words)
    assert config.metric.absent == expected


def test_override_user_partition_without_absent_is_kept() -> None:
    config = resolved()
    config.metric = {"_target_": "my_lab.Halved"}
    load_spec._override(config, ["data.eval_batch_size=1"])
    assert config.metric == {"_target_": "my_lab.Halved"}
    load_spec._override(config, ["metric=ring9"])
    assert config.metric.absent == "released", "that of the data set"


def test_stored_decoder_of_a_former_name_is_read() -> None:
    config = resolved("+experiment=multi_head_modified_night_stage1")
    now = load_spec.load_spec(OmegaConf.to_container(config))
    config.model.decoder = "modified_released"
    before = load_spec.load_spec(OmegaConf.to_container(config))
    assert before.model.plain["decoder"] == "modified_heatnet"
    assert before.plain == now.plain


def test_absent_user_data_set_excludes_classes() -> None:
    config = compose(())
    assert config.metric.absent == "released"
    del config.dataset.absent
    assert config.metric.absent == "exclude"
    for path in sorted((conf_dir() / "dataset").glob("*.yaml")):
        text = path.read_text()
        expected = "exclude" if path.stem in ("folder", "video") else "released"
        assert f"\nabsent: {expected}" in text or "_target_" not in text, path
