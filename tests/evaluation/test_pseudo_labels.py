"""Pseudo-labels of a network whose probabilities are known: what is kept, resumed, refused."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from rgbt.assembly.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.label_map import LabelMap
from rgbt.data.loaders import eval_batches
from rgbt.data.mfnet import CLASSES
from rgbt.data.pseudo_labels import PseudoLabels
from rgbt.engine.evaluate import label_scores, shares
from rgbt.evaluation.images import labels_table, write_pseudo_labels
from rgbt.evaluation.measure import measurement_of
from rgbt.requirements import NetworkRecord
from rgbt.runs.specify import specify
from rgbt.types import Batch, Output, View
from tests.conftest import write_png

NAMES = ("00001D", "00002N", "00003D")
HW = (4, 6)
SURE = (0.5, 0.9, 0.95, 0.3)
"""Probability of the predicted class where thermal is 0, 1, 2, 3; nine classes in all."""

WHERE = np.arange(24).reshape(HW) % 4
"""Thermal of every image."""


class Fixed(nn.Module):
    """Class (thermal + 2 * red) with the probability `SURE[thermal]`, the rest shared by others."""

    num_classes = 9
    record = NetworkRecord(views=("rgbt", "thermal"))

    def __init__(self) -> None:
        super().__init__()
        self.shift = nn.Parameter(torch.zeros(()))
        self.seen: list[View] = []

    def forward(self, rgb: Tensor, thermal: Tensor, views: tuple[View, ...] = ()) -> Output:
        self.seen += views
        level = (255 * thermal[:, 0]).round().long()
        classes = level + (255 * rgb[:, 0] * (views == ("rgbt",))).round().long()
        sure = torch.tensor(SURE)[level]
        others = ((1 - sure) / 8)[:, None].repeat(1, 9, 1, 1)
        found = others.scatter(1, classes[:, None], sure[:, None])
        return Output(found.log() + self.shift, {})


class Constant(nn.Module):
    """The same class scores for every pixel; `outputs` is of its record."""

    num_classes = 9

    def __init__(self, scores: list[float], outputs: str) -> None:
        super().__init__()
        self.record = NetworkRecord(outputs=outputs, views=("rgbt", "thermal"))
        self.scores = torch.tensor(scores)

    def forward(self, rgb: Tensor, thermal: Tensor, views: tuple[View, ...] = ()) -> Output:
        del thermal, views
        return Output(self.scores[None, :, None, None].expand(len(rgb), -1, *rgb.shape[2:]), {})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Images whose thermal is `WHERE` and whose red is 0, 1, 2: their number."""
    made = tmp_path / "mf"
    for number, name in enumerate(NAMES):
        rgb = np.zeros((*HW, 3), np.uint8)
        rgb[..., 0] = number
        write_png(made / "images" / f"{name}.png", np.dstack([rgb, WHERE.astype(np.uint8)]))
        write_png(made / "labels" / f"{name}.png", np.zeros(HW, np.uint8))
    for split in ("train", "val", "test"):
        (made / f"{split}.txt").write_text("\n".join(NAMES))
    return made


def session_of(root: Path, *overrides: str) -> Session:
    words = (
        *("dataset=mfnet", f"dataset.root={root}", "transform=none", "model=mfnet_tiny"),
        *("masker=none", "loss=cross_entropy", "tracking=none", "data.num_workers=0"),
        *("trainer.accelerator=cpu", "trainer.threads=1", "data.eval_batch_size=2"),
    )
    session = open_session(specify(compose([*words, *overrides])))
    return replace(session, model=Fixed(), label="abc")


@pytest.fixture
def session(root: Path) -> Session:
    return session_of(root)


def written(
    session: Session, out: Path, threshold: float = 0.9, view: View = "thermal", **mapped: Any
) -> PseudoLabels:
    wanted = measurement_of(session, "train", view)
    return write_pseudo_labels(session, wanted, out, threshold=threshold, **mapped)


def image(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_sure_pixels_are_kept(session: Session, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    found = written(session, out, threshold=0.8)
    digest = hashlib.sha256()
    for name in NAMES:
        label, confidence = (image(out / of / f"{name}.png") for of in ("labels", "confidence"))
        digest.update(f"{name} (4, 6)\n".encode() + label.tobytes() + confidence.tobytes())
        assert (label.dtype, confidence.dtype) == (np.uint8, np.uint16)
        # 0.5 and 0.3 are below 0.8.
        assert np.array_equal(label, np.choose(WHERE, [255, 1, 2, 255]))
        # Half of 65535 is 32767.5, so either neighbour; 58981.5 and 62258.25 and 19660.5 likewise.
        expected = np.choose(WHERE, [32767.5, 58981.5, 62258.25, 19660.5])
        assert np.abs(confidence - expected).max() <= 0.5
    assert found.digest == digest.hexdigest()
    said = found.manifest
    assert said["kept"] == pytest.approx(0.5)
    assert said["mean_confidence"] == pytest.approx(sum(SURE) / 4, abs=1e-5)
    assert said["by_class"]["car"]["share"] == pytest.approx(0.25)
    assert said["by_class"]["car"]["mean_confidence"] == pytest.approx(0.9, abs=1e-5)
    assert said["by_class"]["bump"] == {"share": 0, "mean_confidence": None}
    assert (said["images"], said["skipped"], found.classes) == (3, [], CLASSES)
    assert (said["teacher"], said["split"], said["view"]) == ("abc", "train", "thermal")
    assert said["threshold"] == 0.8
    assert said["fingerprint"] == session.dataset.fingerprint()
    rows = {row[0]: row[1:] for row in labels_table(found).rows}
    assert rows["car"] == ("25.00", "90.00")
    assert rows["bump"] == ("0.00", "-")
    assert rows["kept"] == ("50.00", "92.50")
    assert rows["all pixels"] == ("100.00", "66.25")


def test_a_confidence_of_the_threshold_is_kept(session: Session, tmp_path: Path) -> None:
    # Two of nine classes with one half each, to the last digit.
    scores = [0.0 if number in (3, 5) else -1e4 for number in range(9)]
    session = replace(session, model=Constant(scores, "scores"))
    for threshold, kept in ((0.5, 3), (0.5000001, 255)):
        out = tmp_path / str(threshold)
        written(session, out, threshold=threshold, view="rgbt")
        assert np.unique(image(out / "labels" / f"{NAMES[0]}.png")).tolist() == [kept]
        # Half of 65535 is 32767.5, rounded to the even neighbour and not down.
        assert np.unique(image(out / "confidence" / f"{NAMES[0]}.png")).tolist() == [32768]


def test_the_view_and_the_mode_of_the_network(session: Session, tmp_path: Path) -> None:
    session.model.train()
    written(session, tmp_path / "out", threshold=0, view="rgbt")
    assert set(session.model.seen) == {"rgbt"}
    assert not session.model.training
    # Red adds the image's number.
    assert np.array_equal(image(tmp_path / "out" / "labels" / f"{NAMES[2]}.png"), WHERE + 2)


def test_classes_are_mapped_after_the_argmax(session: Session, tmp_path: Path) -> None:
    # 0 and 3 become bump. Where 3 is predicted with 0.3, both together have 0.3 + 0.7 / 8.
    groups = {"bump": (0, 3), "car": (1, 2, 4, 5, 6, 7, 8)}
    label_map = LabelMap(num_source=9, targets=CLASSES, groups=groups)
    found = written(session, tmp_path / "out", threshold=0.35, label_map=label_map)
    label = image(tmp_path / "out" / "labels" / f"{NAMES[0]}.png")
    assert np.array_equal(label, np.choose(WHERE, [8, 1, 1, 255]))
    assert found.manifest["label_map"]["groups"]["bump"] == [0, 3]


def test_killed_command_leaves_no_folder_and_overwrites_nothing(
    session: Session, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(*_: object) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr("rgbt.evaluation.images.label_path", dies)
        with pytest.raises(KeyboardInterrupt):
            written(session, out)
    assert [path.name for path in tmp_path.iterdir()] == ["mf"]  # the images alone
    first = written(session, out)
    for content in (out, root):
        before = {path: path.read_bytes() for path in content.rglob("*.png")}
        with pytest.raises(InputError, match="not empty"):
            written(session, content, threshold=0.1)
        assert {path: path.read_bytes() for path in content.rglob("*.png")} == before
    assert PseudoLabels(out).manifest == first.manifest


def test_the_faster_of_two_processes_writes_the_folder(session: Session, tmp_path: Path) -> None:
    class Slow(Fixed):
        def forward(self, *images: Tensor, **others: Any) -> Output:
            if not (tmp_path / "out").exists():
                written(session, tmp_path / "out")
            return super().forward(*images, **others)

    found = written(replace(session, model=Slow()), tmp_path / "out")
    assert found.digest == written(session, tmp_path / "other").digest
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mf", "other", "out"]


def test_images_that_cannot_be_read(root: Path, tmp_path: Path) -> None:
    (root / "images" / f"{NAMES[0]}.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=NAMES[0]):
        written(session_of(root), tmp_path / "raises")
    found = written(session_of(root, "data.on_error=skip"), tmp_path / "skips")
    assert (found.manifest["images"], found.manifest["skipped"]) == (2, [NAMES[0]])


def test_probabilities_at_the_size_of_the_label(session: Session) -> None:
    batches = eval_batches(
        session.dataset, session.dataset.names("train"), session.transform, session.loading
    )
    full = next(iter(batches)).to("cpu")

    def probabilities(model: nn.Module, batch: Batch, view: View = "rgbt") -> Tensor:
        return shares(label_scores(model, batch, session, view), model)

    found = probabilities(session.model, full, "thermal")
    assert (found.shape, found.dtype) == ((2, 9, *HW), torch.float32)
    assert torch.allclose(found.sum(1), torch.ones(2, *HW))
    # Images of half the label's size: scores are enlarged, then normalised.
    small = replace(full, rgb=full.rgb[..., ::2, ::2], thermal=full.thermal[..., ::2, ::2])
    found = probabilities(session.model, small, "thermal")
    scores = session.model(small.rgb, small.thermal, ("thermal",)).logits
    enlarged = nn.functional.interpolate(scores, HW, mode="bilinear", align_corners=False)
    expected = enlarged.exp() / enlarged.exp().sum(1, keepdim=True)
    assert torch.allclose(found, expected, atol=1e-6)
    # Masks of queries give shares.
    found = probabilities(Constant([0.6, 0.2, 0.0], "masks"), full)
    assert torch.allclose(found[1, :, 2, 3], torch.tensor([0.75, 0.25, 0.0]))
    nothing = probabilities(Constant([0.0] * 3, "masks"), full)
    assert nothing.max() == 0
