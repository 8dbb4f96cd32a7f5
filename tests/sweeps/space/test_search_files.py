"""Every file of conf/search is a search that its experiment can run."""

from __future__ import annotations

import hydra
import pytest
from omegaconf import DictConfig

from rgbt.config.compose import conf_dir, flatten, register_resolvers
from rgbt.runs.specify import specify
from sweeps.settings import read_settings
from sweeps.space import Space, build_pruner, build_sampler, ends, parse_space
from tests.models.golden import compose

FILES = sorted(path.stem for path in (conf_dir() / "search").glob("*.yaml"))


def composed(*overrides: str) -> DictConfig:
    """With the node of the sweeper, which a job does not see."""
    register_resolvers()
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra.compose("config", list(overrides), return_hydra_config=True)


def space_of(name: str) -> Space:
    return parse_space(read_settings(composed(f"+search={name}").hydra).space)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "grbm" else pytest.mark.slow) for n in FILES]
)
def test_search_file_is_a_search_of_its_experiment(name: str) -> None:
    config = composed(f"+search={name}")
    assert config.hydra.runtime.choices["hydra/sweeper"] == "study"
    assert config.hydra.mode.name == "MULTIRUN"
    settings = read_settings(config.hydra)
    assert settings.trials
    build_sampler(settings.sampler, 0)
    build_pruner(settings.pruner)
    for overrides in ends(parse_space(settings.space)):
        single = compose(f"+search={name}", *overrides)
        specify(single)
        found = flatten(single)
        for key, text in (word.split("=") for word in overrides):
            assert text.startswith("${px:") or float(text) == found[key]


def test_search_ranges_hold_the_published_values() -> None:
    """SpatialSeg, Tables III, IV, V, and the weights of both releases."""
    grbm, discrete = space_of("grbm"), space_of("grbm_discrete")
    low, high = ends(grbm)
    assert low == ("masker.sigma_div=0.5", "masker.patch_size=${px:8}", "loss.spatial.alpha=0.0")
    assert high == ("masker.sigma_div=32.0", "masker.patch_size=${px:64}", "loss.spatial.alpha=3.0")
    assert discrete["masker.sigma_div"].choices == (1, 2, 4, 8, 16, 32)  # type: ignore[union-attr]
    assert discrete["loss.spatial.alpha"].choices == (0, 1, 1.5, 2, 2.5, 3)  # type: ignore[union-attr]
    # Temporal, Table III: 0.5, 1 and 2 for both.
    assert ends(space_of("temporal"))[1] == ("loss.alpha=2.0", "loss.beta=2.0")
