"""Parameters, operations, memory and times of networks, measured side by side."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt import profile as command
from rgbt.checks import InputError
from rgbt.evaluation import profile as profiling
from rgbt.evaluation.flops import count_flops
from rgbt.evaluation.prepared_network import PreparedNetwork, peak_on_cpu
from rgbt.evaluation.profile import ProfileSettings, profile, ratio_of
from rgbt.evaluation.profile_files import csv_of, profile_grid, write_profile
from rgbt.evaluation.profiled_network import (
    ProfiledNetwork,
    check_networks,
    from_file,
    from_models,
    from_overrides,
    with_onnx,
)
from rgbt.models.mfnet import MFNet
from tests.commands import Call, assert_one_sentence

ENTRY = command.entry
CPU = ("trainer.accelerator=cpu", "trainer.threads=1")
HW = (64, 96)


def tiny(name: str = "mfnet_tiny", *words: str, image_hw: tuple[int, int] = HW) -> ProfiledNetwork:
    return from_overrides(name, [f"model={name}", *CPU, *words], image_hw)


@pytest.fixture
def without_child(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that measures memory imports torch again, which takes seconds."""
    monkeypatch.setattr(profiling, "peak_on_cpu", lambda *_: 2**20)


def test_count_flops_of_convolution_and_matrix_product_by_hand() -> None:
    conv, linear = nn.Conv2d(3, 5, 3, padding=1, bias=False), nn.Linear(6, 2, bias=False)
    image = torch.rand(2, 3, 4, 6)

    def call() -> Tensor:
        maps: Tensor = linear(torch.cat([conv(image).relu(), conv(image)]))
        return maps

    counted = count_flops(call)
    convolution = 2 * (4 * 6 * 5) * (3 * 9)  # of one image; two calls of two images
    product = 2 * (4 * 5 * 4 * 2) * 6
    assert counted.total == 4 * convolution + product
    assert counted.uncounted == {"relu": 2 * 5 * 4 * 6}


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_count_flops_of_attention_includes_both_products(mode: type) -> None:
    q, k = torch.rand(2, 3, 7, 4), torch.rand(2, 3, 5, 4)
    with mode():
        counted = count_flops(lambda: F.scaled_dot_product_attention(q, k, k))
    assert counted.total == 2 * (2 * (2 * 3) * 7 * 5 * 4)
    assert any("softmax" in name for name in counted.uncounted)


def test_ratio_interval_has_the_order_statistics_of_the_binomial() -> None:
    # P(at most 5 of 20 below the median) = 0.0207, of 6: 0.0577; so the 6th and the 15th of 20.
    times = [float(n) for n in range(1, 21)]
    ratio = ratio_of(times, [1.0] * 20)
    assert (ratio.estimate, ratio.low, ratio.high) == (10.5, 6.0, 15.0)
    assert (ratio_of(times[:6], [1.0] * 6).low, ratio_of(times[:6], [1.0] * 6).high) == (1.0, 6.0)
    five = ratio_of(times[:5], [2.0] * 5)
    assert five.estimate == 1.5
    assert math.isnan(five.low)
    assert math.isnan(five.high)


def test_ratio_interval_holds_the_true_median_in_95_percent_of_repetitions() -> None:
    generator = np.random.default_rng(0)
    held = 0
    for _ in range(2000):
        ratio = ratio_of(generator.lognormal(0.3, 0.5, 15).tolist(), [1.0] * 15)
        held += ratio.low <= math.exp(0.3) <= ratio.high
    assert 0.95 <= held / 2000 <= 0.975  # 0.965 for 15 rounds


def test_ratio_does_not_depend_on_a_drift_of_the_machine() -> None:
    drift = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]
    ratio = ratio_of([3 * each for each in drift], drift)
    assert (ratio.estimate, ratio.low, ratio.high) == (3.0, 3.0, 3.0)


def test_from_overrides_uses_paper_scale_and_no_data_set() -> None:
    network = from_overrides("cmx", ["model=cmx_b2"], HW)
    assert network.overrides == ("scale=paper", "model=cmx_b2")
    assert (network.model.values["num_classes"], network.view) == (9, None)
    demo = from_overrides("demo", ["scale=demo", "+experiment=crm"], HW)
    assert demo.overrides[0] == "scale=demo"
    other = from_overrides("other", ["model=mfnet", "dataset.num_classes=14"], HW)
    assert other.model.values["num_classes"] == 14


def test_from_overrides_uses_view_of_source_domain() -> None:
    words = ["model=deeplabv2_tiny", "domains=rgb_to_thermal"]
    assert from_overrides("one", words, HW).view == "rgb"


def test_from_models_names_the_nearest_network() -> None:
    with pytest.raises(InputError, match=r"there is no model 'mfnte'; did you mean 'mfnet"):
        from_models("cmx_b0,mfnte", CPU, HW)


def test_from_file_reads_entries_with_sizes(tmp_path: Path) -> None:
    path = tmp_path / "networks.yaml"
    path.write_text(
        "ours: {overrides: [+experiment=crm, model=mfnet_tiny], image_hw: [32, 48]}\n"
        "theirs: {overrides: [model=cmx_tiny]}\n"
    )
    ours, theirs = from_file(path, CPU, HW)
    assert (ours.name, ours.image_hw, theirs.name, theirs.image_hw) == (
        *("ours", (32, 48)),
        *("theirs", HW),
    )
    assert ours.overrides == ("scale=paper", "+experiment=crm", "model=mfnet_tiny", *CPU)
    assert theirs.trainer.threads == 1


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[a]", "expected a mapping from names to overrides"),
        ("ours: {overrides: [model=mfnet], size: 3}", "size"),
        ("ours: {overrides: [model=mfnet], image_hw: [0, 3]}", "from 1 to 8192"),
        ("ours: {image_hw: [3, 3]}", "overrides"),
    ],
)
def test_from_file_refuses_a_wrong_entry(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "networks.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=sentence):
        from_file(path, (), HW)


def test_check_networks_refuses_equal_names_and_other_threads() -> None:
    with pytest.raises(InputError, match="'mfnet_tiny' is named twice"):
        check_networks([tiny(), tiny()])
    other = from_overrides("b", ["model=mfnet_tiny", *CPU[:1], "trainer.threads=2"], HW)
    with pytest.raises(InputError, match=r"'b' has trainer\.threads=2, but 'mfnet_tiny' has 1"):
        check_networks([tiny(), other])


def test_prepared_network_predicts_the_class_of_every_pixel() -> None:
    network = PreparedNetwork(tiny(image_hw=(50, 70)), batch_size=2)
    classes = network.predict()
    assert (classes.shape, classes.dtype) == ((2, 50, 70), torch.uint8)
    model = tiny().model.build()
    assert isinstance(model, MFNet)
    assert network.parameters == sum(each.numel() for each in model.parameters())
    assert network.trainable == network.parameters


def test_prepared_network_names_a_size_that_the_network_refuses() -> None:
    network = PreparedNetwork(tiny("cmx_tiny", image_hw=(3, 3)), batch_size=1)
    with pytest.raises(InputError, match=r"cmx_tiny: these model.sr_ratios .* got 3 x 3"):
        network.predict()


def test_prepared_network_turns_an_error_of_torch_into_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network = PreparedNetwork(tiny(), batch_size=1)

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("sizes of tensors must match\nat line 3")

    monkeypatch.setattr(MFNet, "forward", fail)
    with pytest.raises(InputError, match=r"mfnet_tiny cannot predict images of 64 x 96 pixels \(s"):
        network.predict()


@pytest.mark.usefixtures("without_child")
def test_profile_measures_every_network_once_in_each_round(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []
    predict = PreparedNetwork.predict

    def watched(self: PreparedNetwork) -> Tensor:
        calls.append(self.network.name)
        return predict(self)

    monkeypatch.setattr(PreparedNetwork, "predict", watched)
    measured = profile([tiny(), tiny("cmx_tiny")], ProfileSettings(rounds=6, warmup=1))
    ours, theirs = measured.networks
    assert calls[:4] == ["mfnet_tiny"] * 2 + ["cmx_tiny"] * 2  # counted, and warmed up
    rounds = [sorted(calls[start : start + 2]) for start in range(4, len(calls), 2)]
    assert rounds == [["cmx_tiny", "mfnet_tiny"]] * 6
    assert len({tuple(calls[start : start + 2]) for start in range(4, len(calls), 2)}) == 2
    assert (len(ours.milliseconds), len(theirs.milliseconds)) == (6, 6)
    assert ours.ratio is not None
    assert theirs.ratio is not None
    assert ours.ratio.estimate == 1.0
    pairs = zip(theirs.milliseconds, ours.milliseconds, strict=True)
    assert theirs.ratio.estimate == pytest.approx(np.median([a / b for a, b in pairs]))
    low, middle, high = ours.quartiles
    assert low <= middle <= high
    assert middle == pytest.approx(np.median(ours.milliseconds))
    assert measured.images_per_second(ours) == pytest.approx(1000 / middle)
    assert (measured.kind, measured.threads) == ("cpu", 1)


@pytest.mark.usefixtures("without_child")
def test_profile_files_hold_the_numbers(tmp_path: Path) -> None:
    measured = profile([tiny(), tiny("cmx_tiny")], ProfileSettings(rounds=1, warmup=1))
    path = tmp_path / "folder" / "profile.json"
    write_profile(measured, path)
    plain = json.loads(path.read_text())
    assert [each["name"] for each in plain["networks"]] == ["mfnet_tiny", "cmx_tiny"]
    assert plain["networks"][0]["peak_memory"] == 2**20
    assert plain["networks"][1]["ratio_low"] is None
    assert "argmax" in plain["prediction"]
    first, second = csv.DictReader(csv_of(measured).splitlines())
    assert (first["name"], second["name"], first["image_hw"]) == ("mfnet_tiny", "cmx_tiny", "64x96")
    assert (first["torch"], first["device"], second["ratio_low"]) == (
        *(torch.__version__, measured.device),
        "",
    )
    grid = profile_grid(measured)
    assert grid.rows[0][5] == "1"
    assert "relu" in " ".join(grid.notes)


def test_profile_without_measurement_counts_only() -> None:
    measured = profile([tiny()], ProfileSettings(measure=False))
    (network,) = measured.networks
    assert network.flops.total > 0
    assert (network.peak_memory, network.milliseconds, network.ratio) == (None, (), None)
    assert profile_grid(measured).header[-1] == "GFLOPs"
    assert len(profile_grid(measured).rows[0]) == 5


@pytest.mark.slow
def test_peak_on_cpu_grows_with_the_image() -> None:
    small, large = (peak_on_cpu(tiny(image_hw=hw), 1) for hw in ((64, 64), (480, 640)))
    assert small is not None
    assert large is not None
    # The first convolution alone has 32-bit values of at least four channels at every pixel.
    assert large - small > 4 * 4 * (480 * 640 - 64 * 64)
    with pytest.raises(InputError, match="cmx_tiny: these model.sr_ratios"):
        peak_on_cpu(tiny("cmx_tiny", image_hw=(3, 3)), 1)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_profile_on_a_gpu_measures_allocated_memory() -> None:
    words = ["model=mfnet_tiny", "trainer.accelerator=cuda"]
    small, large = (
        from_overrides(name, words, hw) for name, hw in (("a", (64, 64)), ("b", (480, 640)))
    )
    measured = profile([small, large], ProfileSettings(rounds=6, warmup=2))
    first, second = measured.networks
    assert measured.kind == "cuda"
    assert measured.device == torch.cuda.get_device_name()
    assert first.peak_memory is not None
    assert second.peak_memory is not None
    assert first.peak_memory > 4 * first.parameters
    assert second.peak_memory - first.peak_memory > 4 * 4 * (480 * 640 - 64 * 64)


@pytest.mark.usefixtures("without_child")
def test_command_prints_and_writes(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "numbers.csv"
    words = ("models=mfnet_tiny,cmx_tiny", "image_hw=64,96", "rounds=2", "warmup=1", *CPU)
    code, printed, err = call(ENTRY, *words, f"out={out}")
    assert code == 0, err
    assert "cmx_tiny" in printed
    assert "GFLOPs" in printed
    with out.open() as file:
        assert [line["name"] for line in csv.DictReader(file)] == ["mfnet_tiny", "cmx_tiny"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((), "no network is named"),
        (("models=cmx_b0", "run=a"), "models and run both name networks"),
        (("models=cmx_b0", "model=mfnet"), "models and model both name networks"),
        (("model=mfnet", "out=a.txt"), "expected a file name that ends in .json or .csv"),
        (("model=mfnet", "image_hw=480"), "image_hw"),
        (("model=mfnet", "masker=grbm_paper"), "'masker' has no effect here"),
        (
            ("model=cmx_tiny", "image_hw=3,3", "measure=false", *CPU),
            "cmx_tiny: these model.sr_ratios",
        ),
        (("run=nothing",), "nothing"),
        (("networks=nothing.yaml",), "does not exist"),
    ],
)
def test_command_refuses_wrong_input(call: Call, words: tuple[str, ...], sentence: str) -> None:
    code, _, err = call(ENTRY, *words)
    assert code == 2
    assert_one_sentence(err, sentence)


@pytest.mark.slow
def test_onnx_is_measured_beside_the_network(without_child: None) -> None:
    network = tiny(image_hw=(32, 48))
    made = profile(with_onnx([network]), ProfileSettings(rounds=2, warmup=1))
    own, onnx = made.networks
    assert [each.network.name for each in made.networks] == ["mfnet_tiny", "mfnet_tiny, ONNX"]
    assert onnx.parameters == own.parameters
    assert onnx.flops.total == own.flops.total > 0
    assert (own.peak_memory, onnx.peak_memory) == (2**20, None)
    assert onnx.ratio is not None
    assert any("same number of threads" in each for each in profile_grid(made).notes)

    prepared = PreparedNetwork(network, batch_size=2)
    expected = prepared.predict()
    prepared.use_onnx()
    assert torch.equal(prepared.predict(), expected)


def test_onnx_is_compared_on_the_cpu_alone() -> None:
    network = tiny()
    on_gpu = replace(network, trainer=replace(network.trainer, accelerator="cuda"))
    with pytest.raises(InputError, match=r"onnx=true compares on the CPU, but 'mfnet_tiny'"):
        with_onnx([on_gpu])
