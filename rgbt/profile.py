"""Measure the efficiency of networks: ``rgbt profile models=cmx_b2,rtfnet_152 image_hw=480,640``.

The command counts parameters and FLOPs, and measures peak memory, latency and images per second.
Networks of one call are measured in one run and compared as ratios.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir, Trust
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.ranges import BatchSize, Pixels

if TYPE_CHECKING:
    from rgbt.evaluation.profiled_network import ProfiledNetwork

HEEDS = ("model", "scale", "experiment", "dataset", "domains", "recipe", "trainer", "debug")
"""Settings that change the network, its images, or the device."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    models: Annotated[
        str, Help("networks, files of conf/model separated by commas: models=cmx_b2,mfnet")
    ] = ""
    run: Annotated[
        str,
        Help("run folders, config keys or MLflow run ids, separated by commas; weights are random"),
    ] = ""
    networks: Annotated[
        Path | None,
        Help(
            "YAML file of networks with any overrides. Each entry is NAME: {overrides: "
            "[+experiment=grbm, model=mask2former_swin_s], image_hw: [480, 640]}"
        ),
    ] = None
    image_hw: Annotated[tuple[Pixels, Pixels], Help("height and width of the images, pixels")] = (
        480,
        640,
    )
    batch_size: Annotated[BatchSize, Help("images of one prediction")] = 1
    rounds: Annotated[
        int, Interval(ge=1, le=100_000), Help("measured predictions of each network")
    ] = 20
    warmup: Annotated[
        int, Interval(ge=1, le=100_000), Help("predictions before them that are not measured")
    ] = 3
    measure: Annotated[
        bool, Help("false: count parameters and FLOPs, and measure neither memory nor time")
    ] = True
    onnx: Annotated[
        bool, Help("true: measure each network also as ONNX in onnxruntime, on the CPU")
    ] = False
    runs_dir: RunsDir = Path("runs")
    trust: Trust = ""
    out: Annotated[Path | None, Help("file for the numbers, .json or .csv")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure networks at their published sizes (scale=paper, unless another scale is given).

    A network is also chosen by overrides: model=mfnet, +experiment=grbm, dataset.num_classes=14.
    Device: trainer.accelerator=cuda trainer.precision=bf16-mixed trainer.threads=2. Weights are
    random and no data set is read. A prediction is normalisation, forward pass, resizing of the
    class scores to the image, and argmax.
    """
    from rgbt.evaluation.profile import ProfileSettings, profile
    from rgbt.evaluation.profile_files import check_out, profile_grid, write_profile
    from rgbt.evaluation.profiled_network import with_onnx
    from rgbt.tracking.terminal import path_lines, print_rich, rich_table

    if options.out is not None:
        check_out(options.out)
    networks = requested_networks(options, overrides)
    if options.onnx:
        networks = with_onnx(networks)
    settings = ProfileSettings(
        batch_size=options.batch_size,
        rounds=options.rounds,
        warmup=options.warmup,
        measure=options.measure,
    )
    measured = profile(networks, settings)
    print_rich(rich_table(profile_grid(measured)))
    if options.out is not None:
        write_profile(measured, options.out)
        print_rich(path_lines([("numbers", str(options.out))]))
    return 0


def requested_networks(options: Options, overrides: list[str]) -> list[ProfiledNetwork]:
    """The networks that one of `models`, `run`, `networks` or the overrides names.

    Raises:
        InputError: none or two of them, or a network that cannot be described.
    """
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation import profiled_network as networks

    is_named = any(word.lstrip("+").startswith(("model=", "experiment=")) for word in overrides)
    given = {"models": options.models, "run": options.run, "networks": options.networks}
    names = [key for key, value in given.items() if value]
    if len(names) > 1 or (options.models and any(w.startswith("model=") for w in overrides)):
        used = " and ".join([*names, "model"][:2])
        raise InputError(f"{used} both name networks; use one of models, run, networks and model.")
    if options.models:
        return networks.from_models(options.models, overrides, options.image_hw)
    if options.run:
        trust = parse_trust(options.trust)
        return networks.from_runs(options.run, options.runs_dir, overrides, options.image_hw, trust)
    if options.networks is not None:
        return networks.from_file(options.networks, overrides, options.image_hw)
    if not is_named:
        raise InputError(
            "no network is named; use models=cmx_b2,mfnet, model=..., +experiment=..., run=... or "
            "networks=FILE.yaml."
        )
    word = next(w for w in overrides if w.lstrip("+").startswith(("model=", "experiment=")))
    name = next((w for w in overrides if w.startswith("model=")), word).partition("=")[2]
    return [networks.from_overrides(name, overrides, options.image_hw)]


entry = PlainCommand(Options, main, HEEDS)

if __name__ == "__main__":
    entry()
