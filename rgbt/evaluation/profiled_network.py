"""The networks that `rgbt profile` measures: chosen by overrides, by a file or by finished runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from rgbt.build.load_run import trusted_settings
from rgbt.checks import InputError, split_list
from rgbt.config.command import composing
from rgbt.config.component import Component
from rgbt.config.compose import check_keys, compose
from rgbt.config.values import check_value
from rgbt.data.domains import Domains
from rgbt.engine.settings import TrainerSettings
from rgbt.exported.description import require_packages
from rgbt.files.yaml_files import read_yaml
from rgbt.ranges import Size, Text
from rgbt.spec.load_spec import load_spec
from rgbt.tracking.run_folder import find_run
from rgbt.types import View

SCALE = "scale=paper"
"""Used where no scale is given: the networks of the demo are tiny."""

Hw = tuple[int, int]
"""Height and width, pixels."""


@dataclass(frozen=True)
class ProfiledNetwork:
    """A network and the size of its images; nothing is built yet.

    Attributes:
        name: in the table, unique.
        model: how it is built.
        trainer: device, threads and precision.
        view: input images; None: those that the network is designed for.
        image_hw: height and width of the images and of the prediction, pixels.
        overrides: of the configuration that describe the network; () for a finished run.
        is_onnx: whether onnxruntime computes it from its exported graph, and not PyTorch.
    """

    name: str
    model: Component
    trainer: TrainerSettings
    view: View | None
    image_hw: Hw
    overrides: tuple[str, ...] = ()
    is_onnx: bool = False


@dataclass(frozen=True, kw_only=True)
class NetworkEntry:
    """One entry of a file of networks.

    Attributes:
        overrides: of the configuration, such as [+experiment=grbm, model=mask2former_swin_s].
        image_hw: height and width of its images; None: the option image_hw.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    overrides: tuple[Text, ...]
    image_hw: Size | None = None


def from_overrides(name: str, overrides: Sequence[str], image_hw: Hw) -> ProfiledNetwork:
    """The network of a configuration, at scale=paper if no scale is given.

    Its data set need not exist: only the number of classes is read.

    Raises:
        InputError: Hydra or the network's constructor refuses an override.
    """
    has_scale = any(word.startswith("scale=") for word in overrides)
    words = [*([] if has_scale else [SCALE]), *overrides]
    with composing(words):
        config = compose(words)
        check_keys(config)
        domains: Domains = Component.from_node(config.domains, "domains").build()
        return ProfiledNetwork(
            name=name,
            model=Component.from_node(config.model, "model"),
            trainer=Component.from_node(config.trainer, "trainer").build(),
            view=domains.source.view,
            image_hw=image_hw,
            overrides=tuple(words),
        )


def from_models(models: str, overrides: Sequence[str], image_hw: Hw) -> list[ProfiledNetwork]:
    """The networks "cmx_b2,mfnet", all with the same overrides; raises as `from_overrides`."""
    names = split_list(models, "networks")
    return [from_overrides(name, [f"model={name}", *overrides], image_hw) for name in names]


def from_file(path: Path, overrides: Sequence[str], image_hw: Hw) -> list[ProfiledNetwork]:
    """The networks of a YAML file: name -> `NetworkEntry`.

    Args:
        path: of the file.
        overrides: of every network, besides those of its entry.
        image_hw: of an entry without a size.

    Raises:
        InputError: no such file, no mapping, an unknown key, or as `from_overrides`.
    """
    plain = read_yaml(path)
    if not isinstance(plain, Mapping) or not plain:
        raise InputError(
            f"networks={path}: expected a mapping from names to overrides, such as "
            "'ours: {overrides: [model=cmx_b2]}'."
        )
    networks = []
    for name, value in plain.items():
        entry: NetworkEntry = check_value(f"{path}, {name}", value, NetworkEntry)
        words = [*entry.overrides, *overrides]
        networks.append(from_overrides(str(name), words, entry.image_hw or image_hw))
    return networks


def from_runs(
    runs: str, runs_dir: Path, overrides: Sequence[str], image_hw: Hw, trust: Sequence[str]
) -> list[ProfiledNetwork]:
    """The networks of finished runs; their weights are not read.

    Raises:
        InputError: no such run, a target that is not trusted, overrides that do not fit.
    """
    networks = []
    for run in split_list(runs, "runs"):
        settings = trusted_settings(find_run(run, runs_dir), trust, overrides)
        spec = load_spec(settings, overrides)
        view = spec.domains.source.view
        networks.append(ProfiledNetwork(run, spec.model, spec.trainer, view, image_hw))
    return networks


def with_onnx(networks: Sequence[ProfiledNetwork]) -> list[ProfiledNetwork]:
    """Each network followed by its exported form, "NAME, ONNX".

    Raises:
        InputError: a device other than the CPU, or the packages for ONNX are missing.
    """
    require_packages()
    for network in networks:
        if network.trainer.accelerator != "cpu":
            raise InputError(
                f"onnx=true compares on the CPU, but '{network.name}' has "
                f"trainer.accelerator={network.trainer.accelerator}; set trainer.accelerator=cpu."
            )
    pairs = [(each, replace(each, name=f"{each.name}, ONNX", is_onnx=True)) for each in networks]
    return [network for pair in pairs for network in pair]


def check_networks(networks: Sequence[ProfiledNetwork]) -> None:
    """Refuse networks that cannot be compared in one run.

    Raises:
        InputError: two of one name, or different devices or numbers of threads.
    """
    first = networks[0]
    for index, network in enumerate(networks):
        if network.name in [each.name for each in networks[:index]]:
            raise InputError(f"'{network.name}' is named twice; name each network once.")
        for key in ("accelerator", "threads"):
            mine, other = getattr(network.trainer, key), getattr(first.trainer, key)
            if mine != other:
                raise InputError(
                    f"'{network.name}' has trainer.{key}={mine}, but '{first.name}' has {other}; "
                    f"networks are compared on one device. Set trainer.{key}={other} for all."
                )
