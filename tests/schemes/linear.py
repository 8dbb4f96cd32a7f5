"""A network, a discriminator and a loss of a few matrices, and SGD written out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.data.domains import Domain, Domains
from rgbt.engine.optimizers import SGD
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.trainer import Hooks, Trainer
from rgbt.models.inputs import expand_cells
from rgbt.randomness import torch_generator
from rgbt.requirements import MaskerRecord, SchemeRecord, record_of
from rgbt.types import Batch, MaskPair, Output, TwoDomains, View
from tests.losses.problems import batch_of

K = 3
LR, MOMENTUM = 0.5, 0.9
Values = dict[str, Tensor]


class Linear(nn.Module):
    """Scores of a pixel: head @ backbone @ its RGB (or thermal, three times); "mixed" adds both."""

    def __init__(self, heads: tuple[str, ...], *, auxiliary: bool = False) -> None:
        super().__init__()
        self.heads_named = heads
        self.backbone = nn.Conv2d(3, K, 1, bias=False)
        self.heads = nn.ModuleDict({name: nn.Conv2d(K, K, 1, bias=False) for name in heads})
        self.only = None if heads else nn.Conv2d(K, K, 1, bias=False)
        self.auxiliary = nn.Conv2d(K, K, 1, bias=False) if auxiliary else None
        self.calls: list[tuple[Any, ...]] = []

    def forward(
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        views: tuple[View, ...] = (),
        head: str | None = None,
        generator: torch.Generator | None = None,
    ) -> Output:
        self.calls.append((views, head, self.training))
        three = thermal.expand(-1, 3, -1, -1)
        if masks is not None:
            cells = expand_cells(masks, len(rgb), (rgb.shape[2], rgb.shape[3]))
            rgb = rgb.masked_fill(cells.rgb[:, None], 0.0)
            three = three.masked_fill(cells.thermal[:, None], 0.0)
        image = {"rgb": rgb, "thermal": three, "rgbt": rgb + three}[(*views, "rgbt")[0]]
        features = self.backbone(image)
        scores = (self.only if head is None else self.heads[head])(features)
        aux = {} if self.auxiliary is None else {"aux_logits": self.auxiliary(features)}
        return Output(scores, {"features": features, **aux})


def cross_entropy(output: Output, batch: Batch, generator: torch.Generator) -> Values:
    """One part, of one pass."""
    del generator
    return {"ce": F.cross_entropy(output.logits, batch.label, ignore_index=255)[None]}


class Nothing:
    record = MaskerRecord(hides_cells=False)


def domains(heads: bool, **target: Any) -> Domains:
    given: dict[str, Any] = {"split": "x", "view": "thermal", "labels": "given", **target}
    return Domains(
        source=Domain(split="x", view="rgb", head="day" if heads else None, labels="given"),
        target=Domain(**given, head="dark" if heads else None),
        target_is="view" if heads else None,
        tested_head="own",
    )


def network(heads: bool, **others: Any) -> Linear:
    torch.manual_seed(3)
    return Linear(("day", "dark") if heads else (), **others)


def images(purpose: str, number: int, confidence: bool = False) -> Batch:
    draw = torch_generator(0, purpose, number)
    rgb, thermal = (
        torch.randint(0, 256, (2, c, 4, 4), generator=draw, dtype=torch.uint8) for c in (3, 1)
    )
    return replace(
        batch_of(torch.randint(0, K, (2, 4, 4), generator=draw)),
        rgb=rgb,
        thermal=thermal,
        confidence=torch.rand(2, 4, 4, generator=draw) if confidence else None,
    )


def pairs(first: int = 0, confidence: bool = False) -> Iterator[TwoDomains]:
    for number in count(first):
        target = images("target", number, confidence=confidence)
        yield TwoDomains(images("source", number), target, number)


def trainer(scheme: Any, model: nn.Module, folder: Path, steps: int, **changes: Any) -> Trainer:
    """The real loop with SGD for every optimiser that the scheme names."""
    fabric = Fabric(accelerator="cpu", devices=1)
    builder = SGD(lr=LR, backbone_multiplier=1.0, momentum=MOMENTUM, weight_decay=0.0)
    built = {
        name: builder(model, without=parts)
        for name, parts in record_of(scheme, SchemeRecord).optimizers.items()
    }
    others = record_of(scheme, SchemeRecord).networks
    builders = record_of(scheme, SchemeRecord).builders
    built |= {name: build(others[name]) for name, build in builders.items()}
    settings: dict[str, Any] = {
        "max_steps": steps,
        "eval_every": 1000,
        "checkpoint_minutes": 1440,
        "log_every": 1,
        "accumulate": 1,
        "clip_norm": None,
        "precision": "32-true",
        "accelerator": "cpu",
        "threads": 1,
        "selection_split": "val",
        **changes,
    }
    log: list[dict[str, float]] = []
    hooks = Hooks()
    hooks.log = lambda step, values: log.append(values)  # type: ignore[method-assign]
    made = Trainer(
        fabric=fabric,
        settings=TrainerSettings(**settings),
        phases=scheme.phases,
        model=model,
        others=others,
        optimizers=built,
        schedule=lambda step, total, per_epoch: 1.0,
        steps_per_epoch=1,
        folder=folder,
        hooks=hooks,
    )
    made.log = log  # type: ignore[attr-defined]
    return made


# ---- the same, by matrices in float64 -------------------------------------------------------


def values_of(module: nn.Module) -> Values:
    """Parameters as matrices, float64."""
    each = ((name, p.detach().double().clone()) for name, p in module.named_parameters())
    return {name: p.flatten(1) if p.dim() > 1 else p for name, p in each}


def pixels(batch: Batch, view: str) -> tuple[Tensor, Tensor]:
    """(N, 3) float64 of images in [0, 1], and (N,) labels."""
    image = batch.rgb if view == "rgb" else batch.thermal.expand(-1, 3, -1, -1)
    return image.permute(0, 2, 3, 1).reshape(-1, 3).double(), batch.label.reshape(-1)


def scores(values: Values, x: Tensor, head: str) -> Tensor:
    return x @ values["backbone.weight"].T @ values[head].T


def nats(z: Tensor, y: Tensor) -> Tensor:
    """Mean cross-entropy by its definition."""
    return (z.exp().sum(1).log() - z[range(len(y)), y]).mean()


def generator_of(purpose: str) -> torch.Generator:
    """One step's."""
    return torch_generator(0, purpose)
