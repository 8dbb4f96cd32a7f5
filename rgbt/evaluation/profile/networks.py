"""The networks that `rgbt profile` measures, and their predictions of random images."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from rgbt.assembly.load_run import trusted_settings
from rgbt.checks import InputError, one_line, split_list
from rgbt.config.component import Component
from rgbt.config.compose import check_keys, compose
from rgbt.config.overrides import composing
from rgbt.config.values import check_value
from rgbt.data.domains import Domains
from rgbt.engine.device import (
    autocast,
    choose_device,
    fix_threads,
    keep_memory,
    set_matmul_precision,
)
from rgbt.engine.evaluate import class_maps
from rgbt.engine.settings import TrainerSettings
from rgbt.exported.onnx_network import exported_network, require_packages
from rgbt.files.yaml_files import read_yaml
from rgbt.randomness import derive, torch_generator
from rgbt.ranges import Size, Text
from rgbt.requirements import NetworkRecord, record_of
from rgbt.runs.folder import find_run
from rgbt.runs.specify import load_spec
from rgbt.types import Batch, View

# The scale where none is given: the networks of the demo are tiny.
SCALE = "scale=paper"

# Height and width, pixels.
Hw = tuple[int, int]


@dataclass(frozen=True)
class ProfiledNetwork:
    """A network and the size of its images; nothing is built yet."""

    name: str  # in the table, unique
    model: Component
    trainer: TrainerSettings  # device, threads and precision
    view: View | None  # input images; None: those that the network is designed for
    image_hw: Hw
    overrides: tuple[str, ...] = ()  # that describe the network; () for a finished run
    is_onnx: bool = False  # onnxruntime computes it from its exported graph, and not PyTorch


@dataclass(frozen=True, kw_only=True)
class NetworkEntry:
    """One entry of a file of networks; without a size, that of the option image_hw."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    overrides: tuple[Text, ...]
    image_hw: Size | None = None


def from_overrides(name: str, overrides: Sequence[str], image_hw: Hw) -> ProfiledNetwork:
    """Compose a network, at scale=paper if no scale is given.

    Its data set need not exist. Raises InputError where Hydra or a constructor refuses an override.
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
    """Compose the networks "cmx_b2,mfnet" with equal overrides; raises as `from_overrides`."""
    names = split_list(models, "networks")
    return [from_overrides(name, [f"model={name}", *overrides], image_hw) for name in names]


def from_file(path: Path, overrides: Sequence[str], image_hw: Hw) -> list[ProfiledNetwork]:
    """Read networks from a YAML file: name -> `NetworkEntry`; `overrides` apply to all."""
    entries = check_value(str(path), read_yaml(path), dict[str, NetworkEntry])
    return [
        from_overrides(name, [*entry.overrides, *overrides], entry.image_hw or image_hw)
        for name, entry in entries.items()
    ]


def from_runs(
    runs: str, runs_dir: Path, overrides: Sequence[str], image_hw: Hw, trust: Sequence[str]
) -> list[ProfiledNetwork]:
    """Return the networks of finished runs; InputError as for other commands."""
    networks = []
    for run in split_list(runs, "runs"):
        settings = trusted_settings(find_run(run, runs_dir), trust, overrides)
        spec = load_spec(settings, overrides)
        view = spec.domains.source.view
        networks.append(ProfiledNetwork(run, spec.model, spec.trainer, view, image_hw))
    return networks


def with_onnx(networks: Sequence[ProfiledNetwork]) -> list[ProfiledNetwork]:
    """Let its exported form follow each network, "NAME, ONNX"; InputError without the packages."""
    require_packages()
    found = []
    for network in networks:
        found += [network, replace(network, name=f"{network.name}, ONNX", is_onnx=True)]
    return found


def check_networks(networks: Sequence[ProfiledNetwork]) -> None:
    """Raise InputError where ratios would mean nothing, or two networks have one name."""
    names = [network.name for network in networks]
    if len(set(names)) < len(names):
        raise InputError(f"networks: a name occurs twice in {', '.join(names)}.")
    for key in ("accelerator", "threads", "matmul_precision"):
        values = {str(getattr(network.trainer, key)): network.name for network in networks}
        if len(values) > 1:
            raise InputError(f"trainer.{key}: networks are compared with one value, got {values}.")
    if any(network.is_onnx for network in networks) and networks[0].trainer.accelerator != "cpu":
        raise InputError("trainer.accelerator: onnx=true compares on the CPU; set it to cpu.")


class PreparedNetwork:
    """A network with random weights on its device; it predicts one batch again and again.

    Raises InputError where the constructor refuses a setting, or the machine lacks the device.
    """

    def __init__(self, network: ProfiledNetwork, batch_size: int) -> None:
        keep_memory()
        fix_threads(network.trainer.threads)
        self.network = network
        self.device = choose_device(network.trainer)
        set_matmul_precision(self.device, network.trainer)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive(0, "weights"))
            model: nn.Module = network.model.build()
        on_gpu = self.device.type == "cuda"
        self._allocated = torch.cuda.memory_allocated(self.device) if on_gpu else 0
        self.parameters = self.trainable = 0
        for weights in model.parameters():
            self.parameters += weights.numel()
            self.trainable += weights.numel() if weights.requires_grad else 0
        # The counter of operations follows gradients otherwise, which a prediction does not have.
        self._model: nn.Module = model.eval().requires_grad_(False).to(self.device)
        self._view = network.view or record_of(model, NetworkRecord).views[0]
        self._batch = random_batch(batch_size, network.image_hw).to(self.device)

    def autocast(self) -> AbstractContextManager[Any]:
        """Return the context of a forward pass at the precision of the network."""
        return autocast(self.device, self.network.trainer.precision)

    def predict(self) -> Tensor:
        """Predict the class of every pixel, (B, H, W) uint8; waits until the device has finished.

        Raises InputError where the network cannot predict images of this size.
        """
        try:
            classes = class_maps(self._model, self._batch, self, self._view)
        except (RuntimeError, ValueError) as error:
            height, width = self.network.image_hw
            where = f"{self.network.name} at image_hw={height},{width}"
            raise InputError(f"{where}: {one_line(error)}.") from error
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        elif self.device.type == "mps":
            torch.mps.synchronize()
        return classes

    def use_onnx(self) -> None:
        """Predict with onnxruntime from now on; InputError where it cannot be exported."""
        name, image_hw = self.network.name, self.network.image_hw
        self._model = exported_network(self._model, self._view, image_hw, name)

    def peak_memory(self) -> int | None:
        """Return the most bytes that weights, batch and a prediction take on CUDA; else None."""
        if self.device.type != "cuda":
            return None
        torch.cuda.reset_peak_memory_stats(self.device)
        self.predict()
        return torch.cuda.max_memory_allocated(self.device) - self._allocated


def random_batch(batch_size: int, image_hw: Hw) -> Batch:
    """Draw images of random values; the speed of a prediction does not depend on them."""
    generator = torch_generator(0, "profile")
    shape = (batch_size, 4, *image_hw)
    images = torch.randint(256, shape, generator=generator, dtype=torch.uint8)
    return Batch(
        rgb=images[:, :3],
        thermal=images[:, 3:],
        label=torch.zeros((batch_size, *image_hw), dtype=torch.uint8),
        name=tuple(f"random {index}" for index in range(batch_size)),
        centre_yx=torch.zeros((batch_size, 2), dtype=torch.int64),
        position=None,
        original_hw=torch.tensor([image_hw] * batch_size),
    )
