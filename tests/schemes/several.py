"""Steps of every scheme and loss with few parameters, run by any number of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.engine.batch_norm import synchronise_batch_norm
from rgbt.geometry.camera import Camera
from rgbt.losses.cross_entropy import CrossEntropy, WithAuxiliary
from rgbt.losses.spatial import PLAIN
from rgbt.losses.temporal import TemporalLoss
from rgbt.losses.unlabelled import Entropy, MaxSquares
from rgbt.maskers.masker import Masker
from rgbt.models.critic import Critic
from rgbt.processes import num_processes, own, total
from rgbt.randomness import torch_generator
from rgbt.requirements import SchemeRecord, record_of
from rgbt.schemes.crm import CRM
from rgbt.schemes.supervised import Supervised
from rgbt.types import IGNORE, Batch, TwoDomains
from tests.losses.problems import batch_of, criterion_of, whole_image
from tests.models.plain import nano
from tests.schemes import test_domains, test_self_training
from tests.schemes import test_temporal as frames
from tests.schemes.linear import Nothing, network
from tests.schemes.test_schemes import ONE
from tests.schemes.test_self_training import DISTANCE

B, K = 4, 4
HW = (32, 64)
CAMERA = Camera(fx=70.0, fy=70.0, cx=31.5, cy=15.5, height=32, width=64)
Values = dict[str, Tensor]


@dataclass
class Case:
    """A scheme, the networks that it trains, and a batch of all processes."""

    scheme: Any
    networks: dict[str, nn.Module]
    data: Any


def batch(classes: int = K, purpose: str = "batch", *, confidence: bool = False) -> Batch:
    """One image has no label at all, and one has few: counts differ between processes."""
    draw = torch_generator(0, purpose)
    blocks = torch.randint(0, classes, (B, HW[0] // 4, HW[1] // 4), generator=draw)
    label = blocks.repeat_interleave(4, 1).repeat_interleave(4, 2)
    label[1] = IGNORE
    label[2, 8:] = IGNORE
    return replace(
        batch_of(label, whole_image(B, *HW) / 2 + 3, (40, 50)),
        rgb=torch.rand(B, 3, *HW, generator=draw),
        thermal=torch.rand(B, 1, *HW, generator=draw),
        name=tuple("abcd"),
        centre_yx=torch.randint(8, 24, (B, 2), generator=draw),
        confidence=torch.rand(B, *HW, generator=draw) ** 2 if confidence else None,
    )


def own_part(data: Any) -> Any:
    """Of a batch, or of both domains: the samples of this process."""
    if isinstance(data, TwoDomains):
        return TwoDomains(own_part(data.source), own_part(data.target), data.step)
    values = {part.name: getattr(data, part.name) for part in fields(data)}
    parts = {name: own(value) for name, value in values.items() if isinstance(value, Tensor)}
    return replace(data, **parts, name=tuple(own(torch.arange(len(data.name))).tolist()))


def doubled(batch: Batch) -> Batch:
    return replace(batch, rgb=batch.rgb.double(), thermal=batch.thermal.double())


def in_float64(name: str, **changes: Any) -> Any:
    """Rounding in float32 changes the gradients of these networks by up to a thousandth."""
    fp64 = {"pixel_decoder_fp32": False} if name == "mask2former" else {}
    return nano(name, **fp64, **changes).double()


# ---- cases ----------------------------------------------------------------------------------

GAUSSIAN = Masker(
    sampler="gaussian_count",
    patch_size=16,
    ratio=0.5,
    sigma_div=2.0,
    sigma_height=None,
    anchor="tracked",
    cell_position="index",
    pairing="rand_comp",
    pattern_probabilities=None,
)
NOT_USED = dict.fromkeys(("sigma_div", "anchor", "cell_position"))
INDEPENDENT = replace(GAUSSIAN, sampler="uniform", pairing="indiv", **NOT_USED)
SPATIAL = replace(
    PLAIN, alpha=2.0, focus="edge", match="weighted", normaliser="weights", passes="fused"
)
SHALLOW = criterion_of(
    num_classes=K, deep_supervision=False, spatial=replace(SPATIAL, passes="all")
)
WEIGHTED = CrossEntropy(class_weights=(0.2, 1.0, 2.0, 3.0))
THREE = CrossEntropy(class_weights=(0.5, 1.0, 2.0))


def crm() -> Case:
    net = in_float64("mask2former", drop_path_rate=0.3)
    loss = criterion_of(num_classes=K, spatial=SPATIAL)
    weights = {"modality_weight": 0.5, "complementary_weight": 2.0, "nonlocal_weight": 3.0}
    scheme = CRM(model=net, loss=loss, masker=GAUSSIAN, **weights)
    return Case(scheme, {"model": net}, doubled(batch()))


def supervised(name: str, loss: Any, masker: Any = None) -> Case:
    net = in_float64(name, num_classes=K)
    scheme = Supervised(model=net, loss=loss, masker=masker or Nothing(), domains=ONE)
    return Case(scheme, {"model": net}, doubled(batch()))


def temporal(name: str, second: Any, form: Any) -> Case:
    net, loss, data = network(False), THREE, batch(3)
    if name == "mask2former":
        net = in_float64(name, num_classes=K, drop_path_rate=0.3)
        loss, data = criterion_of(num_classes=K), doubled(batch())
    both = TemporalLoss(segmentation=loss, alpha=0.5, beta=2.0, second=second, form=form)
    scheme = frames.scheme(net, loss=both, view=frames.view(camera=CAMERA))
    return Case(scheme, {"model": net}, data)


def two_domains(make: Any, *given: Any, heads: bool = False, step: int = 0, **more: Any) -> Case:
    """A scheme of `make` for a network of one or two heads, with a loss of weighted classes."""
    net = network(heads, auxiliary=True)
    scheme = make(net, heads, *given, **more)
    if "loss" not in more:
        scheme = replace(scheme, loss=THREE)
    pseudo = more.get("weighed_by_confidence", False)
    data = TwoDomains(batch(3, "source"), batch(3, "target", confidence=pseudo), step)
    record = record_of(scheme, SchemeRecord)
    trained = {name: record.networks[name] for name in record.builders}
    return Case(scheme, {"model": net, **trained}, data)


def adversarial(*, heads: bool = False, step: int = 1, **changes: Any) -> Case:
    torch.manual_seed(5)
    critic = Critic(in_channels=3, base_width=2, upsample=False, align_corners=False)
    given = {"critic": critic, "critic_optimizer": torch.optim.SGD, **changes}
    return two_domains(test_domains.scheme_of, heads=heads, step=step, **given)


def unlabelled(loss: Any, *, guidance: float = 0.0, heads: bool = False) -> Case:
    given = {"unlabelled": loss, "guidance_weight": guidance, "guidance_threshold": 0.4}
    return two_domains(test_domains.unlabelled, heads=heads, **given)


def self_training(*, heads: bool = False, **changes: Any) -> Case:
    settings: dict[str, Any] = {
        "threshold": 0.4,
        "ignored_top": 0.1,
        "ignored_bottom": 0.2,
        "jitter": 1.0,
        "domains": test_domains.linear.domains(heads, labels="none"),
        "loss": THREE,
    }

    def make(net: Any, _: bool, **more: Any) -> Any:
        return test_self_training.scheme_of(net, masker=INDEPENDENT, **more)

    case = two_domains(make, heads=heads, **settings, **changes)
    for parameter in () if case.scheme.initial is None else case.scheme.initial.parameters():
        parameter.data.mul_(0.5)  # as if the network had been trained since
    return case


def max_squares(normalisation: Any, ratio: float | None) -> MaxSquares:
    return MaxSquares(weight=0.7, normalisation=normalisation, image_wise_ratio=ratio)


HEATNET = test_domains.HEATNET
ADVENT = {**test_domains.LOGISTIC, "judged": "self_information"}

CASES: dict[str, Callable[[], Case]] = {
    "crm": crm,
    "masked": lambda: supervised("mask2former", SHALLOW, INDEPENDENT),
    "temporal masks": lambda: temporal("mask2former", "con", "paper"),
    "temporal con": lambda: temporal("linear", "con", "paper"),
    "temporal con_acc": lambda: temporal("linear", "con_acc", "paper"),
    "temporal con_acc released": lambda: temporal("linear", "con_acc", "released"),
    "temporal dice": lambda: temporal("linear", "dice", "paper"),
    "temporal dice released": lambda: temporal("linear", "dice", "released"),
    "batch norm": lambda: supervised("mfnet", WEIGHTED),
    "labelled": lambda: two_domains(test_domains.labelled, "kept", heads=True),
    "adversarial": adversarial,
    "adversarial two heads": lambda: adversarial(heads=True, gradients="together"),
    "advent": lambda: adversarial(**ADVENT, loss=WithAuxiliary(loss=THREE, weight=0.1)),
    "heatnet critic": lambda: adversarial(**HEATNET, step=0),
    "heatnet": lambda: adversarial(**HEATNET, heads=True),
    "max squares": lambda: unlabelled(max_squares("pixels", None), heads=True),
    "max squares image-wise": lambda: unlabelled(max_squares("entries", 0.2), guidance=0.3),
    "self-training": lambda: self_training(masked_images="both", **DISTANCE),
    "self-training two heads": lambda: self_training(heads=True, weighted_by="image"),
    "entropy": lambda: unlabelled(Entropy(weight=0.7), guidance=0.3),
}
"""Every scheme and every loss."""

# ---- steps ----------------------------------------------------------------------------------


def mean_over_processes(values: Iterable[Tensor]) -> list[Tensor]:
    """The averages over the processes, in one transfer."""
    parts = list(values)
    joined = total(torch.cat([part.detach().flatten() for part in parts])) / num_processes()
    sizes = [part.numel() for part in parts]
    return [new.view_as(old) for new, old in zip(joined.split(sizes), parts, strict=True)]


def averaged_gradients(network: nn.Module) -> list[Tensor]:
    """Of every parameter; 0 where nothing depends on it."""
    return mean_over_processes(
        torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        for parameter in network.parameters()
    )


def run_case(name: str) -> Values:
    """Loss parts and gradients of every phase, and the buffers afterwards, by name."""
    case = CASES[name]()
    for net in case.networks.values():
        assert synchronise_batch_norm(net.train()) is net
    found: Values = {}
    phases = case.scheme.phases(own_part(case.data), lambda purpose: torch_generator(0, purpose))
    for number, phase in enumerate(phases):
        if phase.clear:
            for net in case.networks.values():
                net.zero_grad()
        torch.stack(list(phase.parts.values())).sum().backward()
        for part, value in zip(phase.parts, mean_over_processes(phase.parts.values()), strict=True):
            found[f"{number} loss {part}"] = value
        for title, net in case.networks.items():
            names = [f"{number} gradient {title} {key}" for key, _ in net.named_parameters()]
            found |= dict(zip(names, averaged_gradients(net), strict=True))
    for title, net in case.networks.items():
        found |= {f"buffer {title} {key}": each.clone() for key, each in net.named_buffers()}
    return found
