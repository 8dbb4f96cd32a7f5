"""Measure networks side by side: parameters, operations, peak memory and time of a prediction.

The networks alternate: each round measures every network once, in an order that is drawn for the
round. Other load on the machine so affects all of them, and the ratio of two times of one round is
more exact than the times themselves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median, quantiles

import torch
from rich.progress import Progress, TaskID

from rgbt.engine.progress import progress
from rgbt.evaluation.flops import FlopCount, count_flops
from rgbt.evaluation.prepared_network import PreparedNetwork, peak_on_cpu
from rgbt.evaluation.profiled_network import ProfiledNetwork, check_networks
from rgbt.randomness import numpy_generator
from rgbt.tracking.provenance import machine

CONFIDENCE = 0.95
"""Of the interval of a ratio."""


@dataclass(frozen=True)
class ProfileSettings:
    """How networks are measured.

    Attributes:
        batch_size: images of a prediction.
        rounds: measured predictions of each network.
        warmup: predictions before them that are not measured.
        measure: whether memory and time are measured; False: parameters and operations only.
    """

    batch_size: int = 1
    rounds: int = 20
    warmup: int = 3
    measure: bool = True


@dataclass(frozen=True)
class Ratio:
    """Median over rounds of a time divided by that of the first network in the same round.

    Attributes:
        low: end of the interval of the median, NaN with fewer than six rounds.
        high: other end.
    """

    estimate: float
    low: float
    high: float


@dataclass(frozen=True)
class NetworkProfile:
    """The measurements of one network.

    Attributes:
        network: what was measured.
        parameters: number of all parameters.
        trainable: number of those that are trained.
        flops: operations of the prediction of one batch.
        peak_memory: bytes; None where it was not measured.
        milliseconds: of every round, for one batch; () where nothing was measured.
        ratio: to the first network; None where nothing was measured.
    """

    network: ProfiledNetwork
    parameters: int
    trainable: int
    flops: FlopCount
    peak_memory: int | None = None
    milliseconds: tuple[float, ...] = ()
    ratio: Ratio | None = None

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """First quartile, median and third quartile of the milliseconds; NaN without any."""
        if len(self.milliseconds) < 2:
            only = self.milliseconds[0] if self.milliseconds else math.nan
            return only, only, only
        low, middle, high = quantiles(self.milliseconds, n=4, method="inclusive")
        return low, middle, high


@dataclass(frozen=True)
class Profile:
    """Networks that were measured in one run.

    Attributes:
        kind: of the device: "cpu", "cuda" or "mps".
        device: its model.
        threads: of the CPU.
        torch_version: of PyTorch.
        settings: how they were measured.
        networks: in the order of the request; ratios refer to the first.
    """

    kind: str
    device: str
    threads: int
    torch_version: str
    settings: ProfileSettings
    networks: tuple[NetworkProfile, ...]

    def images_per_second(self, network: NetworkProfile) -> float:
        """Images per second at the median time."""
        return 1000 * self.settings.batch_size / network.quartiles[1]


@dataclass
class _Measured:
    """A network while it is measured."""

    prepared: PreparedNetwork
    flops: FlopCount
    peak: int | None = None
    milliseconds: list[float] = field(default_factory=list)


def profile(networks: Sequence[ProfiledNetwork], settings: ProfileSettings) -> Profile:
    """Measure networks in one run, with a progress bar.

    All of them are kept on the device together.

    Raises:
        InputError: names or devices that do not fit, or images that a network cannot predict.
    """
    check_networks(networks)
    rounds = settings.rounds if settings.measure else 0
    with progress() as display:
        task = display.add_task("preparing", total=len(networks), note="")
        found = [_prepare(network, settings, display, task) for network in networks]
        display.update(task, description="measuring", total=rounds, completed=0, note="rounds")
        for number in range(rounds):
            # Drawn, so that no network always follows the same other one.
            for index in numpy_generator(0, "profile", number).permutation(len(found)):
                found[index].milliseconds.append(_milliseconds(found[index].prepared))
            display.advance(task)
    first = found[0].milliseconds
    return Profile(
        kind=found[0].prepared.device.type,
        device=device_name(found[0].prepared.device),
        threads=torch.get_num_threads(),
        torch_version=torch.__version__,
        settings=settings,
        networks=tuple(_profile_of(each, first) for each in found),
    )


def _prepare(
    network: ProfiledNetwork, settings: ProfileSettings, display: Progress, task: TaskID
) -> _Measured:
    """Build a network, count and measure what needs no rounds, and warm it up."""
    display.update(task, note=network.name)
    prepared = PreparedNetwork(network, settings.batch_size)
    measured = _Measured(prepared, count_flops(prepared.predict))
    if network.is_onnx:
        prepared.use_onnx()
    if settings.measure:
        if prepared.device.type == "cuda":
            measured.peak = prepared.peak_on_gpu()
        elif prepared.device.type == "cpu" and not network.is_onnx:
            measured.peak = peak_on_cpu(network, settings.batch_size)
        for _ in range(settings.warmup):
            prepared.predict()
    display.advance(task)
    return measured


def _milliseconds(prepared: PreparedNetwork) -> float:
    start = time.perf_counter()
    prepared.predict()
    return 1000 * (time.perf_counter() - start)


def _profile_of(measured: _Measured, first: Sequence[float]) -> NetworkProfile:
    return NetworkProfile(
        network=measured.prepared.network,
        parameters=measured.prepared.parameters,
        trainable=measured.prepared.trainable,
        flops=measured.flops,
        peak_memory=measured.peak,
        milliseconds=tuple(measured.milliseconds),
        ratio=ratio_of(measured.milliseconds, first) if first else None,
    )


def ratio_of(times: Sequence[float], first: Sequence[float]) -> Ratio:
    """Median of the ratios of each round with its interval.

    The interval has no assumption about the distribution: its ends are two of the sorted ratios
    (Conover, Practical Nonparametric Statistics, 3rd ed., Sec. 3.2). It holds the true median in at
    least 95 % of repetitions if rounds are independent.
    """
    ratios = sorted(mine / other for mine, other in zip(times, first, strict=True))
    number, rank = len(ratios), -1
    below = 0.0  # probability that at most `rank` of the ratios are below the true median
    while (below := below + math.comb(number, rank + 1) / 2**number) <= (1 - CONFIDENCE) / 2:
        rank += 1
    if rank < 0:
        return Ratio(median(ratios), math.nan, math.nan)
    return Ratio(median(ratios), ratios[rank], ratios[number - 1 - rank])


def device_name(device: torch.device) -> str:
    """The model of a graphics card or processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return str(machine()["cpu"])
