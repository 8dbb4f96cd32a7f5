"""The table of steps, in the order in which they run: cheap and important ones first."""

from __future__ import annotations

from dataclasses import dataclass

NOMINAL = 480.0
"""Seconds of the whole command for which the limits below are given."""


@dataclass(frozen=True)
class Step:
    """One step of the command.

    Attributes:
        name: for `steps=...`, and of its files.
        title: what it measures.
        module: whose function ``measure(task)`` does it.
        seconds: limit with minutes=8; other limits are in proportion. None: what remains.
        least: seconds below which it is not started, and lower bound of its limit.
        needs_cuda: whether nothing of it can be tried on the CPU.
    """

    name: str
    title: str
    module: str
    seconds: float | None
    least: float = 15.0
    needs_cuda: bool = False


_PACKAGE = "tests.benchmarks.gpu"

STEPS = (
    Step("machine", "The machine and its rates", f"{_PACKAGE}.step_machine", 30),
    Step("tests", "Tests marked gpu", f"{_PACKAGE}.step_tests", 90),
    Step("equality", "Losses and classes: CPU against device", f"{_PACKAGE}.step_equality", 60),
    Step("training", "CRM step at the paper's batch", f"{_PACKAGE}.step_training", 95),
    Step("compile", "CRM step, compiled", f"{_PACKAGE}.step_compile", 50),
    Step("waits", "Host synchronisations of a step", f"{_PACKAGE}.step_waits", 35),
    Step("loading", "The input path", f"{_PACKAGE}.step_loading", 45),
    Step("views", "Virtual views against an OpenCV loop", f"{_PACKAGE}.step_views", 20, least=20),
    Step("runs", "Runs at demo scale, alone and eight at once", f"{_PACKAGE}.step_runs", 35),
    Step("table", "A table of the papers at demo scale", f"{_PACKAGE}.step_table", None),
)
