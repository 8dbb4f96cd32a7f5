"""What a run is called, and which group it belongs to."""

from __future__ import annotations

import json
from itertools import product

import pytest
from omegaconf import DictConfig

from rgbt.config.compose import compose
from rgbt.spec.naming import TAGS, VARIED, describe, group_of
from rgbt.tracking.folder import Description


@pytest.fixture(scope="module")
def grbm() -> DictConfig:
    return compose(["+experiment=grbm"])


@pytest.fixture(scope="module")
def adversarial() -> DictConfig:
    return compose(["+experiment=sh_adversarial"])


def shown(config: DictConfig, *words: str) -> tuple[str, str]:
    found = describe(config, ["+experiment=x", "runs_dir=x", "tracking=none", *words])
    return found.name, found.tags["rgbt.group"]


def vary(monkeypatch: pytest.MonkeyPatch, *keys: str) -> None:
    monkeypatch.setenv(TAGS, json.dumps({VARIED: " ".join(keys)}))


def test_a_name_begins_with_what_differs_and_the_group_with_the_experiment(
    grbm: DictConfig,
) -> None:
    assert shown(grbm) == ("seed=0 · grbm", "grbm")
    words = ("seed=0", "masker.sigma_div=2")
    assert shown(grbm, *words) == ("sigma_div=2 seed=0 · grbm", "grbm sigma_div=2")


def test_what_all_points_of_a_sweep_share_comes_last(
    grbm: DictConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    vary(monkeypatch, "masker.sigma_div", "seed")
    name, group = shown(grbm, "trainer.max_steps=4", "masker.sigma_div=2")
    assert name == "sigma_div=2 seed=0 · grbm max_steps=4"
    assert group == "grbm max_steps=4 sigma_div=2", "in typed order, as for a single run"
    vary(monkeypatch, "experiment", "seed")
    assert shown(grbm)[0] == "grbm seed=0"
    assert shown(grbm, "trainer.max_steps=4")[0] == "grbm seed=0 · max_steps=4"


def test_a_key_is_short_only_where_no_other_key_ends_so(
    grbm: DictConfig, adversarial: DictConfig
) -> None:
    assert shown(grbm, "optimizer.lr=1")[1] == "grbm lr=1"
    assert shown(adversarial, "optimizer.lr=1")[1] == "sh_adversarial optimizer.lr=1"
    critic = shown(adversarial, "scheme.critic_optimizer.lr=1")[1]
    assert critic == "sh_adversarial scheme.critic_optimizer.lr=1"
    assert shown(grbm, "dataset.seed=3", "optimizer.lr=1", "scale.lr=2")[1] == (
        "grbm dataset.seed=3 optimizer.lr=1 scale.lr=2"
    )
    assert shown(grbm, "masker=irm", "~masker.ratio")[1] == "grbm masker=irm ~masker.ratio"


def test_names_of_a_grid_differ(adversarial: DictConfig) -> None:
    weights = [f"/data/weights/of/several/networks/{n}/swin_small_patch4_224.pth" for n in "ab"]
    axes = (
        [f"optimizer.lr={value}" for value in ("1", "2")],
        [f"scheme.critic_optimizer.lr={value}" for value in ("1", "2")],
        [f"pretrained={path}" for path in weights],
    )
    names = {shown(adversarial, *words)[0] for words in product(*axes)}
    assert len(names) == 8
    assert max(map(len, names)) < 140


def test_references_and_quotes_are_shown_as_their_value(grbm: DictConfig) -> None:
    # scale=demo has images half as large as the paper's
    assert shown(grbm, "masker.patch_size=${px:64}") == (
        "patch_size=32 seed=0 · grbm",
        "grbm patch_size=32",
    )
    assert shown(grbm, "optimizer.lr=${scale.lr}")[1] == f"grbm lr={grbm.scale.lr}"
    assert shown(grbm, "recipe.dataset='my data'")[0] == "recipe.dataset=my data seed=0 · grbm"


def stored(group: str, config: DictConfig) -> str:
    """The group that is read of a run of `config` made before."""
    params = describe(config, []).params
    old = Description("", {"rgbt.group": group}, params)
    return group_of(old.tags, old.params)


def test_runs_made_before_are_in_the_groups_of_new_ones(
    grbm: DictConfig, adversarial: DictConfig
) -> None:
    assert stored("grbm patch_size=${px:64} lr=0.1", grbm) == "grbm patch_size=32 lr=0.1"
    assert stored("grbm sizes=[1, 2] masker=irm", grbm) == "grbm sizes=[1, 2] masker=irm"
    rate = adversarial.optimizer.lr
    assert stored(f"x lr={rate}", adversarial) == f"x optimizer.lr={rate}"
    assert stored("x lr=77", adversarial) == "x lr=77", "no setting of it has that value"
    assert group_of({}, {}) == ""
