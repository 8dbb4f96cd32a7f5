"""What a run is called, and which group it belongs to."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest

from rgbt.spec.naming import VARIED, describe, group_of
from rgbt.spec.run_spec import RunSpec
from rgbt.tracking.run_files import Description
from tests.composed import specified


@pytest.fixture(scope="module")
def grbm() -> RunSpec:
    return specified(("+experiment=grbm",))


@pytest.fixture(scope="module")
def adversarial() -> RunSpec:
    return specified(("+experiment=sh_adversarial",))


def shown(spec: RunSpec, *words: str, varied: str = "") -> tuple[str, str]:
    typed = ("+experiment=x", "runs_dir=x", "tracking=none", *words)
    tags = {VARIED: varied} if varied else {}
    description = describe(replace(spec, overrides=typed), tags)
    return description.name, description.tags["rgbt.group"]


def test_a_name_begins_with_what_differs_and_the_group_with_the_experiment(
    grbm: RunSpec,
) -> None:
    assert shown(grbm) == ("seed=0 · grbm", "grbm")
    words = ("seed=0", "masker.sigma_div=2")
    assert shown(grbm, *words) == ("sigma_div=2 seed=0 · grbm", "grbm sigma_div=2")


def test_name_what_a_sweep_does_not_vary_is_last(grbm: RunSpec) -> None:
    words = ("trainer.max_steps=4", "masker.sigma_div=2")
    name, group = shown(grbm, *words, varied="masker.sigma_div seed")
    assert name == "sigma_div=2 seed=0 · grbm max_steps=4"
    assert group == "grbm max_steps=4 sigma_div=2", "in typed order, as for a single run"
    varied = "experiment seed"
    assert shown(grbm, varied=varied)[0] == "grbm seed=0"
    assert shown(grbm, "trainer.max_steps=4", varied=varied)[0] == "grbm seed=0 · max_steps=4"


def test_a_key_is_short_only_where_no_other_key_ends_so(
    grbm: RunSpec, adversarial: RunSpec
) -> None:
    assert shown(grbm, "optimizer.lr=1")[1] == "grbm lr=1"
    assert shown(adversarial, "optimizer.lr=1")[1] == "sh_adversarial optimizer.lr=1"
    critic = shown(adversarial, "scheme.critic_optimizer.lr=1")[1]
    assert critic == "sh_adversarial scheme.critic_optimizer.lr=1"
    assert shown(grbm, "dataset.seed=3", "optimizer.lr=1", "scale.lr=2")[1] == (
        "grbm dataset.seed=3 optimizer.lr=1 scale.lr=2"
    )
    assert shown(grbm, "masker=irm", "~masker.ratio")[1] == "grbm masker=irm ~masker.ratio"


def test_names_of_a_grid_differ(adversarial: RunSpec) -> None:
    weights = [f"/data/weights/of/several/networks/{n}/swin_small_patch4_224.pth" for n in "ab"]
    axes = (
        [f"optimizer.lr={value}" for value in ("1", "2")],
        [f"scheme.critic_optimizer.lr={value}" for value in ("1", "2")],
        [f"pretrained={path}" for path in weights],
    )
    names = {shown(adversarial, *words)[0] for words in product(*axes)}
    assert len(names) == 8
    assert max(map(len, names)) < 140


def test_references_and_quotes_are_shown_as_their_value(grbm: RunSpec) -> None:
    # scale=demo has images half as large as the paper's
    assert shown(grbm, "masker.patch_size=${px:64}") == (
        "patch_size=32 seed=0 · grbm",
        "grbm patch_size=32",
    )
    assert shown(grbm, "optimizer.lr=${scale.lr}")[1] == f"grbm lr={grbm.scale.lr}"
    assert shown(grbm, "recipe.dataset='my data'")[0] == "recipe.dataset=my data seed=0 · grbm"


def group_of_older_run(group: str, config: RunSpec) -> str:
    """The group that is read of a run of `config` made before."""
    params = describe(config).params
    old = Description("", {"rgbt.group": group}, params)
    return group_of(old.tags, old.params)


def test_runs_made_before_are_in_the_groups_of_new_ones(
    grbm: RunSpec, adversarial: RunSpec
) -> None:
    assert (
        group_of_older_run("grbm patch_size=${px:64} lr=0.1", grbm) == "grbm patch_size=32 lr=0.1"
    )
    assert (
        group_of_older_run("grbm sizes=[1, 2] masker=irm", grbm) == "grbm sizes=[1, 2] masker=irm"
    )
    rate = adversarial.optimizer.plain["lr"]
    assert group_of_older_run(f"x lr={rate}", adversarial) == f"x optimizer.lr={rate}"
    assert group_of_older_run("x lr=77", adversarial) == "x lr=77", (
        "no setting of it has that value"
    )
    assert group_of({}, {}) == ""
