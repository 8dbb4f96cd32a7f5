"""Exporting a run as a user does, and predicting with the file: one export serves most tests."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from rgbt import evaluate, export, predict
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.evaluation.export import Comparison, compare, only_head
from rgbt.exported.onnx_network import ExportedNetwork
from rgbt.metrics.counts import Counts
from tests.commands import Call, Trained, assert_one_sentence, code_of, short

PREDICT, EXPORT = predict.entry, export.entry
ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))

Change = Callable[[onnx.ModelProto], None]


@pytest.fixture(scope="module")
def exported(trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ONNX file of a small run; to be read."""
    out = tmp_path_factory.mktemp("exported") / "model.onnx"
    assert code_of(EXPORT, [f"run={trained(*ONE)}", f"out={out}"]) == 0
    return out


@pytest.fixture
def changed(exported: Path, tmp_path: Path) -> Callable[[Change], Path]:
    """Writes a copy of the file after a change of its content."""

    def write(change: Change) -> Path:
        proto = onnx.load(exported)
        change(proto)
        path = tmp_path / "changed.onnx"
        path.write_bytes(proto.SerializeToString())
        return path

    return write


def metadata(proto: onnx.ModelProto, key: str) -> onnx.StringStringEntryProto:
    return next(each for each in proto.metadata_props if each.key == f"rgbt.{key}")


def test_predictions_of_the_file_are_those_of_the_run(
    exported: Path, trained: Trained, call: Call, tmp_path: Path
) -> None:
    """Byte for byte, and the counts of an evaluation are equal too."""
    run = trained(*ONE)
    for name, network in (("run", f"run={run}"), ("file", f"exported={exported}")):
        words = (network, "input=test", f"out={tmp_path / name}", f"runs_dir={tmp_path}")
        code, _, err = call(PREDICT, *words)
        assert code == 0, err
    files = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert len(files) == 6, "three images and their overlays"
    for name in files:
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "file" / name).read_bytes()

    counts = tmp_path / "counts.npz"
    code, _, err = call(evaluate.entry, f"exported={exported}", f"out={counts}")
    assert code == 0, err
    assert "MFNet in onnxruntime; checkpoint of step 1" in err
    own = Counts.load(run / "counts_test.npz").counts
    assert np.array_equal(Counts.load(counts).counts, own)


def test_metadata_of_the_file(exported: Path, trained: Trained) -> None:
    proto = onnx.load(exported)
    onnx.checker.check_model(proto)
    found = {each.key: json.loads(each.value) for each in proto.metadata_props}
    assert found["rgbt.run"] == trained(*ONE).name
    assert found["rgbt.image_hw"] == [48, 64]
    assert found["rgbt.classes"][:2] == ["unlabeled", "car"]
    assert (found["rgbt.view"], found["rgbt.head"], found["rgbt.step"]) == ("rgbt", None, 1)
    tracking = found["rgbt.settings"]["tracking"]
    assert list(tracking) == ["_target_"], "its address may hold a password"
    assert b"stack_trace" not in exported.read_bytes(), "it names paths of this machine"
    assert [each.version for each in proto.opset_import if not each.domain] == [18]


def test_scores_of_a_batch_do_not_depend_on_its_size(exported: Path) -> None:
    network = ExportedNetwork.read(exported)
    generator = torch.Generator().manual_seed(0)
    rgb, thermal = (torch.rand(5, c, 48, 64, generator=generator) for c in (3, 1))
    whole = network(rgb, thermal).logits
    assert whole.shape == (5, 9, 48, 64)
    alone = network(rgb[3:4], thermal[3:4]).logits
    assert torch.allclose(whole[3:4], alone, atol=1e-6)
    assert not torch.allclose(whole[2:3], alone, atol=1e-6)


def test_another_size_of_the_images_is_refused(exported: Path, call: Call, tmp_path: Path) -> None:
    words = ("transform.test_short_edge=24", "input=test", f"out={tmp_path / 'out'}")
    code, _, err = call(PREDICT, f"exported={exported}", *words)
    assert code == 2
    assert_one_sentence(err, "takes images of 48 x 64 pixels, but got 24 x 32; export the network")
    assert "image_hw=24,32" in err
    assert not (tmp_path / "out").exists()


def test_a_run_or_a_view_beside_the_file_is_refused(
    exported: Path, call: Call, tmp_path: Path
) -> None:
    words = (f"exported={exported}", "input=test", f"out={tmp_path / 'out'}")
    code, _, err = call(PREDICT, *words, "run=any")
    assert code == 2
    assert_one_sentence(err, "exported")
    code, _, err = call(PREDICT, *words, "modality=rgb")
    assert code == 2
    assert_one_sentence(err, "modality: 'rgb' is not a valid choice")
    assert not (tmp_path / "out").exists()


def test_another_view_or_head_than_that_of_the_graph_is_refused(
    changed: Callable[[Change], Path],
) -> None:
    def of_the_night(proto: onnx.ModelProto) -> None:
        metadata(proto, "head").value = '"night"'

    network = ExportedNetwork.read(changed(of_the_night))
    images = torch.rand(1, 3, 48, 64), torch.rand(1, 1, 48, 64)
    assert network.record.heads == ("night",)
    assert network(*images, views=("rgbt",), head="night").logits.shape == (1, 9, 48, 64)
    with pytest.raises(ValueError, match="head=day: .* has the head 'night'"):
        network(*images, head="day")
    with pytest.raises(ValueError, match="predicts from rgbt alone"):
        network(*images, views=("rgb",))


def test_a_head_for_day_and_one_for_night_must_be_chosen() -> None:
    domains = build(compose(["domains=day_to_night"]).domains)
    dataset = SimpleNamespace(nights=lambda names: tuple("N" in name for name in names))
    session: Any = SimpleNamespace(domains=domains, dataset=dataset)
    source, target = domains.heads
    assert only_head(session, "rgbt", "source", ("1D", "2N")) == source
    assert only_head(session, "rgbt", "target", ("1D", "2N")) == target
    assert only_head(session, "rgbt", "own", ("1N", "2N")) == target
    with pytest.raises(ValueError, match="choose it with head=source or head=target"):
        only_head(session, "rgbt", "own", ("1D", "2N"))


def test_damaged_files_are_refused(exported: Path, tmp_path: Path, call: Call) -> None:
    content = exported.read_bytes()
    for name, damaged in (
        ("cut.onnx", content[: len(content) // 2]),
        ("empty.onnx", b""),
        ("text.onnx", b"not a graph"),
    ):
        (tmp_path / name).write_bytes(damaged)
        code, _, err = call(
            PREDICT, f"exported={tmp_path / name}", "input=test", f"out={tmp_path / 'out'}"
        )
        assert code == 2
        assert_one_sentence(err, f"{tmp_path / name}")
    code, _, err = call(PREDICT, "exported=none.onnx", "input=test", f"out={tmp_path / 'out'}")
    assert code == 2
    assert_one_sentence(err, "there is no such file")


def test_changed_bytes_raise_one_sentence_or_none(
    changed: Callable[[Change], Path],
) -> None:
    path = changed(lambda proto: None)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    messages = []
    for position in rng.integers(0, 4000, 40).tolist():
        damaged = bytearray(content)
        damaged[position] = int(rng.integers(0, 256))
        try:
            ExportedNetwork(bytes(damaged), path)
        except InputError as error:
            messages.append(str(error))
    assert messages
    assert all(str(path) in each for each in messages)


def test_constants_in_other_files_are_refused(changed: Callable[[Change], Path]) -> None:
    def outside(proto: onnx.ModelProto) -> None:
        tensor = proto.graph.initializer[0]
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="../../etc/passwd")

    def inside_a_node(proto: onnx.ModelProto) -> None:
        tensor = onnx.helper.make_tensor("c", onnx.TensorProto.FLOAT, [1], [0.0])
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="/etc/passwd")
        proto.graph.node.append(onnx.helper.make_node("Constant", [], ["c"], value=tensor))

    for change in (outside, inside_a_node):
        with pytest.raises(ValueError, match="keeps constants in another file"):
            ExportedNetwork.read(changed(change))


def test_other_classes_inputs_or_metadata_are_refused(changed: Callable[[Change], Path]) -> None:
    def fewer_classes(proto: onnx.ModelProto) -> None:
        metadata(proto, "classes").value = '["a", "b"]'

    def other_input(proto: onnx.ModelProto) -> None:
        metadata(proto, "image_hw").value = "[96, 128]"

    def no_metadata(proto: onnx.ModelProto) -> None:
        del proto.metadata_props[:]

    def damaged(proto: onnx.ModelProto) -> None:
        metadata(proto, "view").value = '"sonar"'

    for change, sentence in (
        (fewer_classes, "inputs and outputs"),
        (other_input, "inputs and outputs"),
        (no_metadata, "no description of rgbt"),
        (damaged, "no description of rgbt"),
    ):
        with pytest.raises(ValueError, match=sentence):
            ExportedNetwork.read(changed(change))


def test_settings_of_the_file_execute_nothing(
    changed: Callable[[Change], Path], call: Call, tmp_path: Path
) -> None:
    def strange(proto: onnx.ModelProto) -> None:
        entry = metadata(proto, "settings")
        settings = json.loads(entry.value)
        settings["transform"]["_target_"] = "os.system"
        entry.value = json.dumps(settings)

    words = (f"exported={changed(strange)}", "input=test", f"out={tmp_path / 'out'}")
    code, _, err = call(PREDICT, *words)
    assert code == 2
    assert_one_sentence(err, "'transform._target_' names os.system")


def test_a_data_set_of_other_classes_is_refused(
    changed: Callable[[Change], Path], call: Call, tmp_path: Path
) -> None:
    def renamed(proto: onnx.ModelProto) -> None:
        entry = metadata(proto, "classes")
        entry.value = json.dumps(["sky", *json.loads(entry.value)[1:]])

    words = (f"exported={changed(renamed)}", "input=test", f"out={tmp_path / 'out'}")
    code, _, err = call(PREDICT, *words)
    assert code == 2
    assert_one_sentence(err, "classes sky, car")


def test_out_is_checked_before_the_run_is_opened(exported: Path, call: Call) -> None:
    for out, sentence in (
        (exported, "overwrites no file"),
        (exported.with_suffix(".pth"), "expected a file name that ends in .onnx"),
    ):
        code, _, err = call(EXPORT, "run=none", f"out={out}")
        assert code == 2
        assert_one_sentence(err, sentence)
    code, _, err = call(EXPORT, f"exported={exported}", "out=other.onnx")
    assert code == 2
    assert_one_sentence(err, "is exported already")


def test_without_the_extra_its_name_is_in_the_message(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    missing = ("onnx", "onnxscript")
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name in missing else find(name, *a)
    )
    code, _, err = call(EXPORT, "run=none", f"out={tmp_path / 'model.onnx'}")
    assert code == 2
    assert_one_sentence(err, "require the packages onnx, onnxscript")
    assert "pip install 'rgbt[export]'" in err


def test_a_comparison_counts_the_largest_difference_and_equal_classes() -> None:
    scores = torch.tensor([[[[4.0, 1.0]], [[2.0, 3.0]]]])  # classes 0 and 1
    images = [(torch.zeros(1, 3, 1, 2), torch.zeros(1, 1, 1, 2))] * 4

    def reference(rgb: Tensor, thermal: Tensor) -> Tensor:
        return scores.expand(len(rgb), -1, -1, -1)

    def other(rgb: Tensor, thermal: Tensor) -> Tensor:
        # Adds 2.5 to class 1 of the first pixel of the last image of a pair.
        found = reference(rgb, thermal).clone()
        found[1:, 1, 0, 0] += 2.5
        return found

    # Groups of one, two and one image: one of eight pixels has class 1 (4.5) for class 0 (4).
    assert compare(reference, other, images) == Comparison(4, 2.5, 4.0, 7 / 8)
    assert compare(reference, reference, images) == Comparison(4, 0.0, 4.0, 1.0)


def test_a_graph_beyond_the_tolerance_is_refused() -> None:
    Comparison(1, 0.004, 4.0, 0.9995).check(1e-3)
    for difference, equal in ((0.0041, 1.0), (0.0, 0.9985), (float("nan"), 1.0)):
        with pytest.raises(ValueError, match="no file was written"):
            Comparison(1, difference, 4.0, equal).check(1e-3)


@pytest.mark.slow
def test_a_refused_export_leaves_no_file(trained: Trained, call: Call, tmp_path: Path) -> None:
    code, _, err = call(
        EXPORT, f"run={trained(*ONE)}", f"out={tmp_path / 'new' / 'm.onnx'}", "tolerance=0"
    )
    assert code == 2
    assert_one_sentence(err, "tolerance=0")
    assert not (tmp_path / "new").exists()
