"""One training step and one evaluation of an experiment, on the CPU and on a device.

Weights and images are the same. Draws too: they come from generators of the CPU on both sides,
because those of a GPU give other numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.config.compose import compose
from rgbt.data.loaders import eval_batches
from rgbt.evaluation.predict import Predictor
from rgbt.randomness import torch_generator
from rgbt.runs.specify import specify
from rgbt.types import MaskPair


def compare(name: str, device: torch.device) -> dict[str, float]:
    """Relative differences of loss and gradient, and the number of pixels that differ."""
    setups = [smoke_setup(name, each) for each in (torch.device("cpu"), device)]
    # Step 1: where steps alternate, step 0 trains the discriminator alone.
    loaded = next(setups[0].batches(range(1, 2)))
    losses, norms, maps = [], [], []
    for setup in setups:
        draw_on_cpu(setup.scheme, setup.session.device)
        loss, norm = one_step(setup, loaded)
        losses.append(loss)
        norms.append(norm)
        maps.append(classes(setup))
    return {
        "loss difference": _relative(*losses),
        "gradient difference": _relative(*norms),
        "pixels differing": sum(int((a != b).sum()) for a, b in zip(*maps, strict=True)),
        "pixels": sum(each.numel() for each in maps[0]),
    }


def smoke_setup(experiment: str, device: torch.device) -> TrainingSetup:
    """The objects of a smoke run without its upstream runs, whose pseudo-labels would weigh."""
    words = [f"+experiment={experiment}", "+debug=smoke", "data.num_workers=0", "tracking=none"]
    # TF32 differs from the CPU by 1e-3.
    words += [f"trainer.accelerator={device.type}", "trainer.matmul_precision=highest"]
    words.append("trainer.max_steps=1000")
    if specify(compose(words), words).scheme.plain.get("weighed_by_confidence"):
        words.append("scheme.weighed_by_confidence=false")
    return set_up_training(specify(compose(words), words), upstream_finished=False)


def one_step(setup: TrainingSetup, loaded: Any) -> tuple[float, float]:
    """Loss and norm of the gradient of the network, of one training step without its update."""
    device = setup.session.device
    model = setup.model.train()
    total = torch.zeros((), device=device)
    for phase in setup.scheme.phases(loaded.to(device), lambda name: torch_generator(0, name, 0)):
        loss = torch.stack(list(phase.parts.values())).sum()
        setup.fabric.backward(loss)
        total += loss.detach()
    gradients = [each.grad for each in model.parameters() if each.grad is not None]
    return float(total), float(torch.stack([each.norm() for each in gradients]).norm())


def classes(setup: TrainingSetup) -> list[Tensor]:
    """Classes of every pixel of the test split, on the CPU, of the network as it was drawn."""
    session = replace(setup.session, model=setup.model)
    predictor = Predictor(session)
    batches = eval_batches(
        session.dataset, session.dataset.names("test"), session.transform, session.loading
    )
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
