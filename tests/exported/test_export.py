"""Exporting a run as a user does, and predicting with the file: one export serves most tests."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from rgbt import evaluate, export, predict
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import available, compose
from rgbt.evaluation import export as exporting
from rgbt.evaluation.export import Agreement, compare, only_head, other_sizes
from rgbt.evaluation.predict import heads_of
from rgbt.exported.onnx_network import (
    ExportedNetwork,
    GraphDescription,
    ScoresOfImages,
    exported_network,
    onnx_bytes,
)
from rgbt.metrics.counts import Counts
from rgbt.requirements import NetworkRecord, record_of
from rgbt.types import Output
from tests.commands import SPLITS, Call, Trained, assert_one_sentence, code_of, short
from tests.conftest import write_data

PREDICT, EXPORT = predict.entry, export.entry
ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))
ALIKE = ("cmx_tiny", "deeplabv2_tiny", "dinov3_tiny", "heatnet_tiny", "semseg_tiny")
TINY = [name for name in available("model") if name.endswith("_tiny") and name not in ALIKE]

Proto = onnx.ModelProto
Changed = Callable[[Callable[[Proto], object]], Path]


@pytest.fixture(scope="module")
def exported(trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ONNX file of a small run; to be read."""
    out = tmp_path_factory.mktemp("exported") / "model.onnx"
    assert code_of(EXPORT, [f"run={trained(*ONE)}", f"out={out}"]) == 0
    return out


@pytest.fixture
def changed(exported: Path, tmp_path: Path) -> Changed:
    """Writes a copy of the file after a change of its content."""

    def write(change: Callable[[Proto], object]) -> Path:
        proto = onnx.load(exported)
        change(proto)
        path = tmp_path / "changed.onnx"
        path.write_bytes(proto.SerializeToString())
        return path

    return write


def stating(key: str, value: object) -> Callable[[Proto], None]:
    """A change of one entry of the metadata."""

    def change(proto: Proto) -> None:
        (entry,) = (entry for entry in proto.metadata_props if entry.key == f"rgbt.{key}")
        entry.value = json.dumps(value(json.loads(entry.value)) if callable(value) else value)

    return change


@pytest.mark.slow
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
    found = {entry.key: json.loads(entry.value) for entry in proto.metadata_props}
    assert found["rgbt.run"] == trained(*ONE).name
    assert found["rgbt.image_hw"] == [48, 64]
    assert found["rgbt.classes"][:2] == ["unlabeled", "car"]
    assert (found["rgbt.view"], found["rgbt.head"], found["rgbt.step"]) == ("rgbt", None, 1)
    tracking = found["rgbt.settings"]["tracking"]
    assert list(tracking) == ["_target_"], "its address may hold a password"
    assert b"stack_trace" not in exported.read_bytes(), "it names paths of this machine"
    assert [opset.version for opset in proto.opset_import if not opset.domain] == [18]


def test_view_or_head_not_in_the_graph_is_refused(changed: Changed) -> None:
    network = ExportedNetwork.read(changed(stating("head", "night")))
    images = torch.rand(1, 3, 48, 64), torch.rand(1, 1, 48, 64)
    assert network.record.heads == ("night",)
    assert network(*images, views=("rgbt",), head="night").logits.shape == (1, 9, 48, 64)
    with pytest.raises(ValueError, match="head=day: .* has the head 'night'"):
        network(*images, head="day")
    with pytest.raises(ValueError, match="predicts from rgbt alone"):
        network(*images, views=("rgb",))


def test_heads_for_day_and_night_must_be_chosen() -> None:
    domains = build(compose(["domains=day_to_night"]).domains)
    dataset = SimpleNamespace(nights=lambda names: tuple("N" in name for name in names))
    session: Any = SimpleNamespace(domains=domains, dataset=dataset)
    source, target = domains.heads

    def chosen(head: Any, *names: str) -> str | None:
        predictor: Any = SimpleNamespace(heads=heads_of(session, "rgbt", head))
        return only_head(predictor, names)

    assert chosen("source", "1D", "2N") == source
    assert chosen("target", "1D", "2N") == target
    assert chosen("own", "1N", "2N") == target
    with pytest.raises(ValueError, match="choose it with head=source or head=target"):
        chosen("own", "1D", "2N")


def strange(settings: dict[str, Any]) -> dict[str, Any]:
    return {**settings, "transform": {**settings["transform"], "_target_": "os.system"}}


def test_what_a_prediction_refuses(
    exported: Path, changed: Changed, call: Call, tmp_path: Path
) -> None:
    """In one sentence, before anything is written."""
    (tmp_path / "cut.onnx").write_bytes(exported.read_bytes()[:4000])
    (tmp_path / "text.onnx").write_bytes(b"not a graph")
    for file, word, said in (
        (exported, "transform.test_short_edge=24", "takes images of 48x64, got 24x32; export"),
        (exported, "run=any", "exported"),
        (exported, "modality=rgb", "corruption=removed:thermal gives it a black one"),
        (tmp_path / "cut.onnx", "", "cut.onnx"),
        (tmp_path / "text.onnx", "", "text.onnx"),
        (tmp_path / "none.onnx", "", "there is no such file"),
        (changed(stating("settings", strange)), "", "'transform._target_' names os.system"),
    ):
        words = (f"exported={file}", "input=test", f"out={tmp_path / 'out'}", *filter(None, [word]))
        code, _, err = call(PREDICT, *words)
        assert code == 2, word
        assert_one_sentence(err, said)
        assert not (tmp_path / "out").exists()
    other = changed(stating("classes", lambda known: ["sky", *known[1:]]))
    _, _, err = call(PREDICT, f"exported={other}", "input=test", f"out={tmp_path / 'out'}")
    assert_one_sentence(err, "classes sky, car")


def outside(proto: Proto) -> None:
    tensor = proto.graph.initializer[0]
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../etc/passwd")


def inside_a_node(proto: Proto) -> None:
    tensor = onnx.helper.make_tensor("c", onnx.TensorProto.FLOAT, [1], [0.0])
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")
    proto.graph.node.append(onnx.helper.make_node("Constant", [], ["c"], value=tensor))


def test_constants_in_other_files_are_refused(changed: Changed) -> None:
    for change in (outside, inside_a_node):
        with pytest.raises(ValueError, match="keeps constants in another file"):
            ExportedNetwork.read(changed(change))


def test_other_classes_inputs_or_metadata_are_refused(changed: Changed) -> None:
    for change, sentence in (
        (stating("classes", ["a", "b"]), "inputs and outputs"),
        (stating("image_hw", [96, 128]), "inputs and outputs"),
        (lambda proto: proto.metadata_props.clear(), "no description of rgbt"),
        (stating("view", "sonar"), "no description of rgbt"),
    ):
        with pytest.raises(ValueError, match=sentence):
            ExportedNetwork.read(changed(change))


def test_what_an_export_refuses(
    exported: Path, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new = tmp_path / "new.onnx"
    for words, sentence in (
        (("run=none", f"out={exported}"), "overwrites no file"),
        (("run=none", f"out={new.with_suffix('.pth')}"), "a file name that ends in .onnx"),
        ((f"exported={exported}", f"out={new}"), "is exported already"),
    ):
        code, _, err = call(EXPORT, *words)
        assert code == 2
        assert_one_sentence(err, sentence)
    find, missing = importlib.util.find_spec, ("onnx", "onnxscript")
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name in missing else find(name, *a)
    )
    code, _, err = call(EXPORT, "run=none", f"out={new}")
    assert code == 2
    assert_one_sentence(err, "require onnx, onnxscript")
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
    assert compare(reference, other, images) == Agreement(4, 2.5, 4.0, 7 / 8)
    assert compare(reference, reference, images) == Agreement(4, 0.0, 4.0, 1.0)
    Agreement(1, 0.004, 4.0, 0.9995).check(1e-3)
    for difference, equal in ((0.0041, 1.0), (0.0, 0.9985), (float("nan"), 1.0)):
        with pytest.raises(ValueError, match="no file was written"):
            Agreement(1, difference, 4.0, equal).check(1e-3)


def test_size_is_that_of_most_images(
    trained: Trained, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first of three test images is wider than others; the network stands for its graph."""
    names = SPLITS["test"]
    root = write_data(tmp_path / "mf", SPLITS, (48, 64))
    for kind in ("images", "labels"):
        path = root / kind / f"{names[0]}.png"
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:40])
    seen: list[tuple[int, ...]] = []

    def computed(graph: ScoresOfImages, _: Path) -> Callable[..., Output]:
        def compute(rgb: Tensor, thermal: Tensor) -> Output:
            seen.extend([(rgb.shape[2], rgb.shape[3])] * len(rgb))
            return Output(graph(rgb, thermal), {})

        return compute

    monkeypatch.setattr(exporting, "onnx_bytes", lambda graph, _: graph)
    monkeypatch.setattr(exporting, "ExportedNetwork", computed)
    monkeypatch.setattr(exporting, "write_atomic", lambda *_: None)
    others = [(37, 64), (48, 43), (61, 81)]  # 3/4, 2/3 and 5/4 of the sides, made odd
    fits = "2 of 3 images of test are 48x64, others 48x77"
    for words, sizes, said in (
        ((), [(48, 64)] * 2, (f"{fits}, which the file does not take\n", "2 images of test\n")),
        (("image_hw=48,77",), [(48, 77)], ("1 of 3 images", "compared    1 images of test\n")),
        (("image_hw=32,32",), [(32, 32)] * 3, ("0 of 3 images", "3 images of test, resized\n")),
        (
            ("image_hw=dynamic",),
            [(48, 77), (48, 64), (48, 64), *others],
            (f"{fits}\n", "3 images of test, one also as 37x64, 48x43, 61x81\n"),
        ),
    ):
        seen.clear()
        out = tmp_path / "new.onnx"
        place = (f"run={trained(*ONE)}", f"dataset.root={root}", f"out={out}")
        code, printed, err = call(EXPORT, *place, *words)
        assert code == 0, err
        assert sorted(seen) == sorted(sizes)
        for words_printed in said:
            assert words_printed in printed


@pytest.mark.slow
@pytest.mark.parametrize(("name", "is_right"), [("deeplabv2_tiny", True), ("semseg_tiny", False)])
def test_dynamic_graph_is_compared_at_other_sizes(name: str, is_right: bool) -> None:
    """One network has the same scores at any size; in the other, pools have the traced size."""
    torch.manual_seed(0)
    network = build(compose([f"model={name}", "model.num_classes=9"]).model).eval()
    graph = ScoresOfImages(network, view=record_of(network, NetworkRecord).views[0], head=None)
    made = GraphDescription(
        network=name,
        classes=tuple("abcdefghi"),
        view=record_of(network, NetworkRecord).views[0],
        outputs="scores",
        image_hw=(48, 64),
        dynamic=True,
        settings={},
    )
    exported = ExportedNetwork(onnx_bytes(graph, made), Path(name))
    images = [
        (torch.rand(1, 3, *hw), torch.rand(1, 1, *hw)) for hw in ((48, 64), *other_sizes((48, 64)))
    ]
    try:
        found = compare(graph, lambda *pair: exported(*pair).logits, images)
        found.check(1e-5)
    except InputError:
        assert not is_right
    else:
        assert is_right


@pytest.mark.slow
@pytest.mark.parametrize("name", TINY)
def test_scores_of_the_graph_are_those_of_the_network(name: str) -> None:
    torch.manual_seed(0)
    network = build(compose([f"model={name}", "model.num_classes=9"]).model).eval()
    view = record_of(network, NetworkRecord).views[0]
    exported = exported_network(network, view, (64, 96), name)
    graph = ScoresOfImages(network, view=view, head=None)
    images = [(torch.rand(1, 3, 64, 96), torch.rand(1, 1, 64, 96)) for _ in range(6)]
    found = compare(graph, lambda *pair: exported(*pair).logits, images)
    assert found.difference <= 1e-5 * found.largest
    assert found.equal == 1.0


def test_a_network_that_reads_values_is_refused_with_advice() -> None:
    class Branching(torch.nn.Module):
        def forward(self, rgb: Tensor, thermal: Tensor, views: object) -> object:
            del views
            return Output(rgb if float(thermal.sum()) > 1 else thermal, {})

    made = GraphDescription(
        network="Branching",
        classes=("a",),
        view="rgbt",
        outputs="scores",
        image_hw=(4, 4),
        settings={},
    )
    with pytest.raises(ValueError, match=r"Branching cannot be exported .* x\.shape\[0\]"):
        onnx_bytes(ScoresOfImages(Branching(), view="rgbt", head=None), made)


def test_onnxruntime_stores_and_sends_nothing(tmp_path: Path) -> None:
    code = "from rgbt.exported import onnx_network as n; n.require_packages(); import onnxruntime"
    suppressing = ("CI", "PYTEST", "GITHUB", "TF_BUILD", "ORT_", "XDG_")  # it is quiet in tests
    kept = {k: v for k, v in os.environ.items() if not k.startswith(suppressing)}
    subprocess.run([sys.executable, "-c", code], env=kept | {"HOME": str(tmp_path)}, check=True)
    assert not [*tmp_path.rglob("deviceid")]
