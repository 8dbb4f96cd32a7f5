"""Every file of conf/search is a search that its experiment can run."""

from __future__ import annotations

from typing import Any

import hydra
import pytest
from omegaconf import DictConfig

from rgbt.config.compose import conf_dir, flatten, register_resolvers
from rgbt.runs.specify import specify
from sweeps.settings import read_settings
from sweeps.space.samplers import build_pruner, build_sampler
from sweeps.space.space import Choice, Parameter, as_overrides, parse_space, plain_space
from tests.models.golden import compose

FILES = sorted(path.stem for path in (conf_dir() / "search").glob("*.yaml"))


def composed(*overrides: str) -> DictConfig:
    """With the node of the sweeper, which a job does not see."""
    register_resolvers()
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra.compose("config", list(overrides), return_hydra_config=True)


def space_of(name: str) -> dict[str, Any]:
    return plain_space(composed(f"+search={name}").hydra.sweeper.space)


def ends(parameter: Parameter) -> tuple[Choice, ...]:
    return parameter.choices or (parameter.low, parameter.high)


@pytest.mark.parametrize("name", FILES)
def test_the_file_chooses_its_experiment_and_sets_the_sweeper(name: str) -> None:
    config = composed(f"+search={name}")
    sweeper = config.hydra.sweeper
    assert config.hydra.runtime.choices["hydra/sweeper"] == "study"
    assert config.hydra.mode.name == "MULTIRUN"
    assert config.name == config.hydra.runtime.choices.experiment
    settings = read_settings(sweeper)
    assert settings.trials
    assert settings.space
    build_sampler(settings.sampler, len(settings.objectives))
    build_pruner(settings.pruner, len(settings.objectives))


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "grbm" else pytest.mark.slow) for n in FILES]
)
def test_every_end_of_every_range_is_a_configuration(name: str) -> None:
    known = flatten(compose(f"+search={name}"))
    parameters = parse_space(space_of(name))
    assert {parameter.key for parameter in parameters} <= set(known)
    for place in (0, -1):
        chosen = {one.key: ends(one)[place] for one in parameters}
        config = compose(f"+search={name}", *as_overrides(chosen))
        specify(config)
        values = flatten(config)
        for key, value in chosen.items():
            assert str(value).startswith("${px:") or values[key] == value


def test_ranges_hold_the_published_values() -> None:
    """SpatialSeg, Tables III, IV, V, and the weights of both releases."""
    sigma, patch, alpha = parse_space(space_of("grbm"))
    assert (sigma.low, sigma.high, sigma.log) == (0.5, 32, True)
    assert patch.choices == tuple(f"${{px:{size}}}" for size in (8, 16, 32, 64))
    assert (alpha.low, alpha.high) == (0, 3)
    published = {one.key: one.choices for one in parse_space(space_of("grbm_discrete"))}
    assert published["masker.sigma_div"] == (1, 2, 4, 8, 16, 32)
    assert published["loss.spatial.alpha"] == (0, 1, 1.5, 2, 2.5, 3)
    # Temporal, Table III: 0.5, 1 and 2 for both.
    assert [(one.low, one.high) for one in parse_space(space_of("temporal"))] == [(0.5, 2.0)] * 2
    released = flatten(compose("+experiment=crm"))
    for parameter in parse_space(space_of("loss")):
        assert parameter.low < released[parameter.key] < parameter.high
