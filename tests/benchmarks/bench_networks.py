"""Time and memory of every network at 256x320, and against transformers' where it has the same one.

Each network runs in a separate process, so that its peak memory is its own. Compared are the RGB
branch of our Mask2Former with all its decoders against transformers' Mask2Former with Swin, and one
stream of CMX's encoder against SegFormer's; both sides in one process, in turns.

Run: python -m tests.benchmarks.bench_networks [name ...] (ratios: pip install transformers)
"""

from __future__ import annotations

import json
import resource
import statistics
import sys
from collections.abc import Callable

from tests.benchmarks.timing import in_process, seconds  # isort: skip - before torch

from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.engine.device import keep_memory
from tests.models.golden import network

MODULE = "tests.benchmarks.bench_networks"
SIZE = (256, 320)
ROUNDS = 3
NETWORKS = (
    *("mask2former_tiny", "mask2former_swin_t", "mask2former_swin_s", "mask2former_swin_b"),
    *("cmx_tiny", "cmx_b0", "cmx_b2", "cmx_b4", "rtfnet_tiny", "rtfnet_50", "rtfnet_152"),
    *("cmnext_tiny", "cmnext_b0", "cmnext_b2", "cmnext_b4"),
    *("mfnet_tiny", "mfnet", "heatnet_tiny", "heatnet"),
    *("deeplabv2_tiny", "deeplabv2"),
)
COMPARED = ("mask2former_swin_t", "cmx_b0", "cmx_b2")
Step = Callable[[], Tensor]


def images() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(1, 3, *SIZE, generator=generator)
    return rgb, torch.rand(1, 1, *SIZE, generator=generator)


def total(output: Any) -> Tensor:
    """One number that every prediction has a part in."""
    tensors = [value for value in output.aux.values() if value.requires_grad]
    if output.logits is not None:
        tensors.append(output.logits)
    return torch.stack([tensor.float().sum() for tensor in tensors]).sum()


def cpu(step: Step, *, backward: bool) -> float:
    """CPU seconds of one step."""
    if backward:
        return seconds(lambda: step().backward())[0]
    with torch.no_grad():
        return seconds(step)[0]


def one(name: str) -> dict[str, float]:
    """CPU seconds of forward (evaluation) and of forward and backward (training), peak memory."""
    net = network(name)
    pair, generator = images(), torch.Generator().manual_seed(1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    forward = [cpu(lambda: total(net.eval()(*pair)), backward=False) for _ in range(ROUNDS + 1)]
    eval_peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    both = [
        cpu(lambda: total(net.train()(*pair, generator=generator)), backward=True)
        for _ in range(ROUNDS)
    ]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "millions": sum(p.numel() for p in net.parameters()) / 1e6,
        "forward": statistics.median(forward[1:]),
        "step": statistics.median(both),
        "forward_mib": (eval_peak - before) / 1024,
        "mib": peak / 1024,
    }


def against_transformers(name: str) -> tuple[nn.Module, Step, nn.Module, Step]:
    """Our module with a step of it, transformers' with the same."""
    ours = network(name, **({"drop_path_rate": 0.0}))
    rgb, thermal = images()
    if name.startswith("mask2former"):
        theirs = transformers_mask2former()
        normalised = ours.inputs(rgb, thermal).rgb

        def step() -> Tensor:
            return total(ours(rgb, thermal, views=("rgb",)))

        def their_step() -> Tensor:
            out = theirs(pixel_values=normalised, output_auxiliary_logits=True)
            layers = [out, *map(_Layer, out.auxiliary_logits)]
            return torch.stack(
                [x.masks_queries_logits.sum() + x.class_queries_logits.sum() for x in layers]
            ).sum()

        return ours, step, theirs, their_step
    theirs = transformers_segformer(ours)
    normalised = ours.inputs(rgb, thermal).rgb

    def stream() -> Tensor:
        x, found = normalised.permute(0, 2, 3, 1).contiguous(), []
        for stage in range(4):
            x = ours.backbone._stage("", stage, x, None)
            found.append(x.sum())
        return torch.stack(found).sum()

    def their_stream() -> Tensor:
        out = theirs(pixel_values=normalised, output_hidden_states=True)
        return torch.stack([x.sum() for x in out.hidden_states]).sum()

    return ours, stream, theirs, their_stream


class _Layer:
    """An auxiliary prediction of transformers, by attribute."""

    def __init__(self, values: dict[str, Tensor]) -> None:
        self.masks_queries_logits = values["masks_queries_logits"]
        self.class_queries_logits = values["class_queries_logits"]


def transformers_mask2former() -> nn.Module:
    from transformers import Mask2FormerConfig, Mask2FormerForUniversalSegmentation, SwinConfig

    swin = SwinConfig(
        **{"embed_dim": 96, "depths": [2, 2, 6, 2], "num_heads": [3, 6, 12, 24]},
        **{"window_size": 7, "drop_path_rate": 0.0},
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )
    config = Mask2FormerConfig(backbone_config=swin, num_labels=9)
    return Mask2FormerForUniversalSegmentation(config)


def transformers_segformer(ours: nn.Module) -> nn.Module:
    from transformers import SegformerConfig, SegformerModel

    depths = list(ours.backbone.depths)
    widths = [ours.get_submodule(f"backbone.norm{i}").weight.numel() for i in range(1, 5)]
    config = SegformerConfig(
        **{"depths": depths, "hidden_sizes": widths, "num_attention_heads": [1, 2, 5, 8]},
        **{"sr_ratios": [8, 4, 2, 1], "drop_path_rate": 0.0, "reshape_last_stage": True},
    )
    return SegformerModel(config)


def compare(name: str) -> dict[str, float]:
    ours, step, theirs, their_step = against_transformers(name)
    found: dict[str, list[float]] = {"forward": [], "forward_hf": [], "step": [], "step_hf": []}
    for _ in range(ROUNDS + 1):
        for label, module, call in (("", ours, step), ("_hf", theirs, their_step)):
            module.eval()
            found[f"forward{label}"].append(cpu(call, backward=False))
            module.train()
            found[f"step{label}"].append(cpu(call, backward=True))
    return {key: statistics.median(values[1:]) for key, values in found.items()}


def main() -> None:
    words = sys.argv[1:]
    if words and words[0] in ("--one", "--compare"):
        keep_memory()
        print(json.dumps((one if words[0] == "--one" else compare)(words[1])))
        return
    print("network, 1 x 256 x 320, CPU s      params M   forward  fwd+bwd   MiB forward  MiB peak")
    for name in words or NETWORKS:
        row = in_process(MODULE, "--one", name)
        print(
            f"{name:<32} {row['millions']:10.2f} {row['forward']:9.2f} {row['step']:8.2f} "
            f"{row['forward_mib']:13.0f} {row['mib']:9.0f}",
            flush=True,
        )
    if find_spec("transformers") is None:
        print("transformers is not installed: no ratios")
        return
    for name in [name for name in COMPARED if name in (words or COMPARED)]:
        row = in_process(MODULE, "--compare", name)
        print(
            f"{name:<20} against transformers: forward {row['forward']:.2f} / "
            f"{row['forward_hf']:.2f} s = {row['forward_hf'] / row['forward']:.2f}x, "
            f"fwd+bwd {row['step']:.2f} / {row['step_hf']:.2f} s = "
            f"{row['step_hf'] / row['step']:.2f}x",
            flush=True,
        )


if __name__ == "__main__":
    main()
