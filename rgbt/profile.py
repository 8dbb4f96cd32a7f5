"""Measure networks: ``rgbt profile models=cmx_b2,rtfnet_152 image_hw=480,640``."""

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
    from rgbt.evaluation.profile.networks import ProfiledNetwork

# Settings that change the network, its images, or the device.
HEEDS = ("model", "scale", "experiment", "dataset", "domains", "recipe", "trainer", "debug")

Rounds = Annotated[int, Interval(ge=1, le=100_000)]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    models: Annotated[str, Help("files of conf/model separated by commas: models=cmx_b2,mfnet")] = (
        ""
    )
    run: Annotated[str, Help("finished runs, separated by commas; weights are random")] = ""
    networks: Annotated[
        Path | None,
        Help("YAML file with entries NAME: {overrides: [+experiment=grbm], image_hw: [480, 640]}"),
    ] = None
    image_hw: Annotated[tuple[Pixels, Pixels], Help("height and width of the images")] = (480, 640)
    batch_size: Annotated[BatchSize, Help("images of one prediction")] = 1
    rounds: Annotated[Rounds, Help("measured predictions of each network")] = 20
    warmup: Annotated[Rounds, Help("predictions before them that are not measured")] = 3
    measure: Annotated[bool, Help("false: count parameters and FLOPs only")] = True
    onnx: Annotated[bool, Help("measure each network also as ONNX in onnxruntime")] = False
    runs_dir: RunsDir = Path("runs")
    trust: Trust = ""
    out: Annotated[Path | None, Help("file for the numbers, .json or .csv")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure networks at their published sizes (scale=paper, unless another scale is given).

    A network is also chosen by overrides: model=mfnet, +experiment=grbm. Device:
    trainer.accelerator=cuda trainer.threads=2. Weights are random, and no data set is read.
    """
    from rgbt.evaluation.profile.rounds import check_out, profile, profile_grid, write_profile
    from rgbt.terminal import path_lines, print_rich, rich_table

    if options.out is not None:
        check_out(options.out)
    networks, setup = profile(
        requested_networks(options, overrides),
        batch_size=options.batch_size,
        rounds=options.rounds if options.measure else 0,
        warmup=options.warmup,
    )
    print_rich(rich_table(profile_grid(networks, setup)))
    if options.out is not None:
        write_profile(networks, setup, options.out)
        print_rich(path_lines([("numbers", str(options.out))]))
    return 0


def requested_networks(options: Options, overrides: list[str]) -> list[ProfiledNetwork]:
    """Return the networks of `models`, `run` or `networks`, or the one that overrides describe."""
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.profile import networks

    image_hw = options.image_hw
    given = [key for key in ("models", "run", "networks") if getattr(options, key)]
    if len(given) > 1 or not (given or overrides):
        raise InputError(f"expected one of models, run, networks or model=..., got {given}.")
    if options.models:
        found = networks.from_models(options.models, overrides, image_hw)
    elif options.run:
        trust = parse_trust(options.trust)
        found = networks.from_runs(options.run, options.runs_dir, overrides, image_hw, trust)
    elif options.networks is not None:
        found = networks.from_file(options.networks, overrides, image_hw)
    else:
        found = [networks.from_overrides(" ".join(overrides), overrides, image_hw)]
    return networks.with_onnx(found) if options.onnx else found


entry = PlainCommand(Options, main, HEEDS)

if __name__ == "__main__":
    entry()
