"""Parameters, operations, memory and times of networks, measured side by side."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt import profile as command
from rgbt.checks import InputError
from rgbt.evaluation.profile.networks import (
    PreparedNetwork,
    ProfiledNetwork,
    check_networks,
    from_file,
    from_overrides,
    with_onnx,
)
from rgbt.evaluation.profile.rounds import count_flops, profile, profile_grid, write_profile
from tests.commands import Call, assert_one_sentence

ENTRY = command.entry
CPU = ("trainer.accelerator=cpu", "trainer.threads=1")
HW = (64, 96)


def tiny(name: str = "mfnet_tiny", *words: str, image_hw: tuple[int, int] = HW) -> ProfiledNetwork:
    return from_overrides(name, [f"model={name}", *CPU, *words], image_hw)


def test_count_flops_of_convolution_and_matrix_product_by_hand() -> None:
    conv, linear = nn.Conv2d(3, 5, 3, padding=1, bias=False), nn.Linear(6, 2, bias=False)
    image = torch.rand(2, 3, 4, 6)
    convolution = 2 * (4 * 6 * 5) * (3 * 9)  # of one image; two calls of two images
    product = 2 * (4 * 5 * 4 * 2) * 6
    counted = count_flops(lambda: linear(torch.cat([conv(image).relu(), conv(image)])))
    assert counted == 4 * convolution + product


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_count_flops_of_attention_includes_both_products(mode: type) -> None:
    q, k = torch.rand(2, 3, 7, 4), torch.rand(2, 3, 5, 4)
    with mode():
        assert count_flops(lambda: F.scaled_dot_product_attention(q, k, k)) == 2 * (
            2 * (2 * 3) * 7 * 5 * 4
        )


def test_from_overrides_uses_paper_scale_and_no_data_set() -> None:
    network = from_overrides("cmx", ["model=cmx_b2"], HW)
    assert network.overrides == ("scale=paper", "model=cmx_b2")
    assert (network.model.values["num_classes"], network.view) == (9, None)
    other = from_overrides("other", ["model=mfnet", "dataset.num_classes=14"], HW)
    assert other.model.values["num_classes"] == 14
    words = ["model=deeplabv2_tiny", "domains=rgb_to_thermal"]
    assert from_overrides("one", words, HW).view == "rgb"


def test_from_file_reads_entries_with_sizes(tmp_path: Path) -> None:
    path = tmp_path / "networks.yaml"
    path.write_text(
        "ours: {overrides: [+experiment=crm, model=mfnet_tiny], image_hw: [32, 48]}\n"
        "theirs: {overrides: [model=cmx_tiny]}\n"
    )
    ours, theirs = from_file(path, CPU, HW)
    assert (ours.name, ours.image_hw) == ("ours", (32, 48))
    assert (theirs.name, theirs.image_hw) == ("theirs", HW)
    assert ours.overrides == ("scale=paper", "+experiment=crm", "model=mfnet_tiny", *CPU)
    for text, key in (
        ("[a]", "networks.yaml"),
        ("ours: {overrides: [model=mfnet], size: 3}", "size"),
        ("ours: {overrides: [model=mfnet], image_hw: [0, 3]}", "image_hw"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=key):
            from_file(path, (), HW)


def test_check_networks_refuses_what_cannot_be_compared() -> None:
    own = tiny()
    on_gpu = replace(own, name="b", trainer=replace(own.trainer, accelerator="cuda"))
    other = replace(own, name="b", trainer=replace(own.trainer, threads=2))
    exact = replace(own, name="b", trainer=replace(own.trainer, matmul_precision="highest"))
    for networks, key in (
        ([own, own], "networks"),
        ([own, other], "trainer.threads"),
        ([own, exact], "trainer.matmul_precision"),
        ([own, on_gpu], "trainer.accelerator"),
        (with_onnx([on_gpu]), "trainer.accelerator"),
    ):
        with pytest.raises(InputError, match=key):
            check_networks(networks)


def test_prepared_network_predicts_the_class_of_every_pixel() -> None:
    network = PreparedNetwork(tiny(image_hw=(50, 70)), batch_size=2)
    classes = network.predict()
    assert (classes.shape, classes.dtype) == ((2, 50, 70), torch.uint8)
    model: nn.Module = tiny().model.build()
    assert network.parameters == sum(weights.numel() for weights in model.parameters())


def test_profile_measures_every_network_once_in_each_round(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[str] = []
    predict = PreparedNetwork.predict

    def watched(self: PreparedNetwork) -> Tensor:
        calls.append(self.network.name)
        return predict(self)

    monkeypatch.setattr(PreparedNetwork, "predict", watched)
    networks, setup = profile([tiny(), tiny("cmx_tiny")], rounds=6, warmup=1)
    assert calls[:4] == ["mfnet_tiny"] * 2 + ["cmx_tiny"] * 2  # counted, and warmed up
    rounds = [tuple(calls[start : start + 2]) for start in range(4, len(calls), 2)]
    assert sorted(map(sorted, rounds)) == [["cmx_tiny", "mfnet_tiny"]] * 6
    assert len(set(rounds)) == 2
    ours, theirs = networks.to_dict("records")
    pairs = zip(theirs["milliseconds"], ours["milliseconds"], strict=True)
    assert theirs["ratio"] == pytest.approx(np.median([a / b for a, b in pairs]))
    median = np.median(ours["milliseconds"])
    assert ours["latency_ms"] == pytest.approx(median)
    assert ours["images_per_second"] == pytest.approx(1000 / median)
    assert (setup["kind"], setup["threads"]) == ("cpu", 1)
    grid = profile_grid(networks, setup)
    assert grid.header[-3:] == ("latency, ms", "images/s", "ratio")
    assert (grid.rows[0][-1], grid.rows[1][-1]) == ("1.000", f"{theirs['ratio']:.3f}")
    write_profile(networks, setup, tmp_path / "profile.json")
    first, second = json.loads((tmp_path / "profile.json").read_text())["networks"]
    assert (first["name"], first["image_hw"], first["peak_memory"]) == ("mfnet_tiny", "64x96", None)
    assert len(second["milliseconds"]) == 6
    write_profile(networks, setup, tmp_path / "profile.csv")
    _, line = csv.DictReader((tmp_path / "profile.csv").open())
    assert float(line["ratio"]) == pytest.approx(theirs["ratio"])
    assert (line["peak_memory"], line["torch"]) == ("", torch.__version__)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_profile_on_a_gpu_measures_allocated_memory() -> None:
    words = ["model=mfnet_tiny", "trainer.accelerator=cuda"]
    sizes = {"a": (64, 64), "b": (480, 640)}
    networks = [from_overrides(name, words, hw) for name, hw in sizes.items()]
    measured, setup = profile(networks, rounds=6, warmup=2)
    first, second = measured.to_dict("records")
    assert setup["device"] == torch.cuda.get_device_name()
    assert first["peak_memory"] > 4 * first["parameters"]
    assert second["peak_memory"] - first["peak_memory"] > 4 * 4 * (480 * 640 - 64 * 64)


def test_command_counts_without_measurement(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "numbers.json"
    words = ("models=mfnet_tiny,cmx_tiny", "image_hw=64,96", "measure=false", *CPU)
    code, printed, err = call(ENTRY, *words, f"out={out}")
    assert code == 0, err
    assert "GFLOPs" in printed
    assert "latency" not in printed
    for network in json.loads(out.read_text())["networks"]:
        assert network["flops"] > 0
        assert (network["latency_ms"], network["milliseconds"]) == (None, [])


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ((), "models, run, networks"),
        (("models=cmx_b0", "run=a"), "models"),
        (("models=cmx_b0,mfnte",), "did you mean 'mfnet"),
        (("model=mfnet", "image_hw=480"), "image_hw"),
        (("model=mfnet", "masker=grbm_paper"), "masker"),
        (("run=nothing",), "nothing"),
        (("networks=nothing.yaml",), "nothing.yaml"),
    ],
)
def test_command_refuses_wrong_input(call: Call, words: tuple[str, ...], key: str) -> None:
    code, _, err = call(ENTRY, *words)
    assert code == 2
    assert_one_sentence(err, key)


@pytest.mark.slow
def test_onnx_is_measured_beside_the_network() -> None:
    network = tiny(image_hw=(32, 48))
    made, _ = profile(with_onnx([network]), rounds=2, warmup=1)
    assert list(made["name"]) == ["mfnet_tiny", "mfnet_tiny, ONNX"]
    for key in ("parameters", "flops"):
        assert made[key][0] == made[key][1] > 0
    prepared = PreparedNetwork(network, batch_size=2)
    expected = prepared.predict()
    prepared.use_onnx()
    assert torch.equal(prepared.predict(), expected)
