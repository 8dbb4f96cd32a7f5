"""Losses, gradients and classes of every scheme and network: CPU against the device.

Weights and images are the same. Draws too: they come from generators of the CPU on both sides,
because those of a GPU give other numbers. TF32 is off, so that differences are those of rounding;
a matching that rounding turns changes a loss by more.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rgbt.assembly.training_setup import TrainingSetup
from rgbt.config.compose import available
from rgbt.data.loaders import eval_batches
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import EvaluationRequest
from rgbt.randomness import torch_generator
from rgbt.types import MaskPair
from tests.benchmarks.gpu.device import arithmetic, checked
from tests.benchmarks.gpu.project import setup_of, smoke_words
from tests.benchmarks.gpu.task import Task, sentence_of

CPU = torch.device("cpu")

FIRST = (
    *("crm", "grbm", "spatialseg", "baseline", "mfnet", "rtfnet", "cmx", "heatnet_rgb_only"),
    *("temporal_con", "temporal_con_acc", "temporal_dice", "temporal_con_released"),
    *("rtfnet_temporal_con", "sh_source", "sh_max_squares", "sh_both", "sh_adversarial"),
    *("heatnet", "multi_head_night", "multi_head_modified_night", "multi_head_modified_thermal"),
    *("self_training_night", "cmnext", "dinov2", "rgb_teacher_semseg"),
)
"""Experiments that cover every scheme, loss and network; the others follow as time allows."""

SMOKE = ("crm", "temporal_con", "sh_adversarial")


def measure(task: Task) -> None:
    """One row for each experiment; one that cannot run is a row with its error."""
    device = checked(task.device)
    names = list(SMOKE if task.smoke else experiments())
    largest: dict[str, float] = {}
    with arithmetic("fp32"):
        for name in task.as_time_allows(names, first=3.0):
            try:
                row = compare(name, device)
            except Exception as error:
                traceback.print_exc()
                task.row(experiment=name, error=sentence_of(error)[:300])
                largest["failed"] = largest.get("failed", 0) + 1
                continue
            task.row(experiment=name, **row)
            for key in ("loss difference", "gradient difference", "pixels differing"):
                largest[key] = max(largest.get(key, 0.0), row[key])
    task.headline(", ".join(f"{key} {value:.2g}" for key, value in largest.items()))
    if "failed" in largest:
        raise AssertionError(f"{int(largest['failed'])} experiments could not run on both devices")


def experiments() -> list[str]:
    """All experiments, those of `FIRST` first."""
    return [*FIRST, *(name for name in available("experiment") if name not in FIRST)]


def compare(name: str, device: torch.device) -> dict[str, Any]:
    """One step and one evaluation of an experiment on the CPU and on `device`."""
    setups = [setup_of(smoke_words(name), each) for each in (CPU, device)]
    # Step 1: where steps alternate, step 0 trains the discriminator alone.
    loaded = next(setups[0].batches(range(1, 2)))
    losses, norms, maps = [], [], []
    for setup in setups:
        draw_on_cpu(setup.scheme, setup.session.device)
        loss, norm = one_step(setup, loaded)
        losses.append(loss)
        norms.append(norm)
        maps.append(classes(setup))
    pixels = sum(each.numel() for each in maps[0])
    differing = sum(int((one != other).sum()) for one, other in zip(*maps, strict=True))
    return {
        "scheme": type(setups[0].scheme).__name__,
        "network": type(setups[0].session.model).__name__,
        "loss on the CPU": losses[0],
        "loss difference": _relative(*losses),
        "gradient difference": _relative(*norms),
        "pixels differing": differing,
        "pixels": pixels,
    }


def one_step(setup: TrainingSetup, loaded: Any) -> tuple[float, float]:
    """Loss and norm of the gradient of the network, of one training step without its update."""
    device = setup.session.device
    model = setup.model.train()

    def generator_of(purpose: str) -> torch.Generator:
        return torch_generator(0, purpose, 0)

    total = torch.zeros((), device=device)
    for phase in setup.scheme.phases(loaded.to(device), generator_of):
        loss = torch.stack(list(phase.parts.values())).sum()
        setup.fabric.backward(loss)
        total += loss.detach()
    gradients = [each.grad for each in model.parameters() if each.grad is not None]
    return float(total), float(torch.stack([each.norm() for each in gradients]).norm())


def classes(setup: TrainingSetup) -> list[Tensor]:
    """Classes of every pixel of the test split, on the CPU, of the network as it was drawn."""
    session = setup.session
    predictor = Predictor(session, setup.model, EvaluationRequest(split="test"))
    batches = eval_batches(session.dataset, "test", session.transform, session.loading)
    return [predictor.classes(batch.to(session.device)).cpu() for batch in batches]


def draw_on_cpu(scheme: Any, device: torch.device) -> None:
    """Let the masker and the view of a scheme draw on the CPU, and move what they drew."""
    if hasattr(scheme, "masker"):
        scheme.masker = _masker(scheme.masker)
    if hasattr(scheme, "view"):
        scheme.view = _View(scheme.view, device)


def _masker(masker: Any) -> Callable[..., MaskPair]:
    def drawn(image_hw: tuple[int, int], centre_yx: Tensor, generator: torch.Generator) -> MaskPair:
        masks = masker(image_hw, centre_yx.cpu(), generator)
        return MaskPair(*(each.to(centre_yx.device) for each in masks))

    return drawn


class _View:
    """A view whose angles are drawn on the CPU and moved to the device."""

    def __init__(self, view: Any, device: torch.device) -> None:
        self._view = view
        self._device = device

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        angles: Tensor = self._view.draw(count, generator)
        return angles.to(self._device)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._view, name)


def _relative(one: float, other: float) -> float:
    return abs(one - other) / max(abs(one), 1e-12)
