"""Pseudo-labels of a network whose probabilities are known: what is kept, resumed, refused."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from rgbt.build.session import Session, open_session
from rgbt.checks import InputError, RunError
from rgbt.config.compose import compose
from rgbt.data.cache.dataset import CachedDataset
from rgbt.data.domains import Domain, Domains
from rgbt.data.label_map import LabelMap
from rgbt.data.mfnet import CLASSES
from rgbt.data.pseudo_labels import PseudoLabels
from rgbt.engine.evaluate import probabilities
from rgbt.evaluation import images
from rgbt.evaluation import pseudo_labels as pseudo
from rgbt.evaluation.pseudo_labels import (
    Labelling,
    summary,
    write_pseudo_labels,
)
from rgbt.evaluation.request import EvaluationRequest
from rgbt.files.atomic import holding
from rgbt.requirements import Record
from rgbt.spec.specify import specify
from rgbt.types import Output, View
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
    record = Record(views=("rgbt", "thermal"))

    def __init__(self) -> None:
        super().__init__()
        self.shift = nn.Parameter(torch.zeros(()))
        self.seen: list[View] = []
        self.calls = 0

    def forward(self, rgb: Tensor, thermal: Tensor, views: tuple[View, ...] = ()) -> Output:
        self.seen += views
        self.calls += len(rgb)
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
        self.record = Record(outputs=outputs, views=("rgbt", "thermal"))
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
    config = compose(
        [
            *("dataset=mfnet", f"dataset.root={root}", "transform=none", "model=mfnet_tiny"),
            *("masker=none", "loss=cross_entropy", "tracking=none", "data.num_workers=0"),
            *("trainer.accelerator=cpu", "trainer.threads=1", "data.eval_batch_size=2"),
            *overrides,
        ]
    )
    return replace(open_session(specify(config)), model=Fixed())


@pytest.fixture
def session(root: Path) -> Session:
    return session_of(root)


def written(session: Session, out: Path, threshold: float = 0.9, **others: Any) -> PseudoLabels:
    teacher = others.pop("teacher", "abc")
    labelling = Labelling(threshold, others.pop("label_map", None))
    request = EvaluationRequest(**{"split": "train", "view": "thermal", **others})
    return write_pseudo_labels(session, teacher, request, labelling, out)


def image(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_sure_pixels_are_kept(session: Session, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    found = written(session, out, threshold=0.8)
    for name in NAMES:
        label, confidence = (
            image(out / "labels" / f"{name}.png"),
            image(out / "confidence" / f"{name}.png"),
        )
        assert (label.dtype, confidence.dtype) == (np.uint8, np.uint16)
        # 0.5 and 0.3 are below 0.8.
        assert np.array_equal(label, np.choose(WHERE, [255, 1, 2, 255]))
        # Half of 65535 is 32767.5, so either neighbour; 58981.5 and 62258.25 and 19660.5 likewise.
        expected = np.choose(WHERE, [32767.5, 58981.5, 62258.25, 19660.5])
        assert np.abs(confidence - expected).max() <= 0.5
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
    assert sorted(path.name for path in out.iterdir()) == [
        *(".lock", "confidence", "labels", "pseudo_labels.json"),
    ]

    grid = summary(found)
    rows = {row[0]: row[1:] for row in grid.rows}
    assert rows["car"] == ("25.00", "90.00")
    assert rows["person"] == ("25.00", "95.00")
    assert rows["bump"] == ("0.00", "-")
    assert rows["kept"] == ("50.00", "92.50")
    assert rows["all pixels"] == ("100.00", "66.25")


def test_threshold_zero_keeps_all_and_one_out_of_range_is_refused(
    session: Session, tmp_path: Path
) -> None:
    written(session, tmp_path / "all", threshold=0)
    assert np.array_equal(image(tmp_path / "all" / "labels" / f"{NAMES[0]}.png"), WHERE)
    for wrong in (-0.1, 1.1):
        with pytest.raises(InputError, match=r"threshold must be between 0 and 1"):
            written(session, tmp_path / "never", threshold=wrong)


def test_a_confidence_of_the_threshold_is_kept_and_rounded(
    session: Session, tmp_path: Path
) -> None:
    # Two of nine classes with one half each, to the last digit.
    scores = [0.0 if number in (3, 5) else -1e4 for number in range(9)]
    session = replace(session, model=Constant(scores, "scores"))
    for threshold, kept in ((0.5, 3), (0.5000001, 255)):
        out = tmp_path / str(threshold)
        written(session, out, threshold=threshold, view="rgbt")
        assert np.unique(image(out / "labels" / f"{NAMES[0]}.png")).tolist() == [kept]
        # Half of 65535 is 32767.5, rounded to the even neighbour and not down.
        assert np.unique(image(out / "confidence" / f"{NAMES[0]}.png")).tolist() == [32768]


class Heads(nn.Module):
    """The head "day" predicts class 1 everywhere, "dark" class 2."""

    num_classes = 9
    record = Record(views=("rgbt", "thermal"))
    heads = ("day", "dark")

    def forward(
        self, rgb: Tensor, thermal: Tensor, views: tuple[View, ...] = (), head: str = ""
    ) -> Output:
        del thermal, views
        scores = torch.zeros(len(rgb), 9, *rgb.shape[2:])
        scores[:, {"day": 1, "dark": 2}[head]] = 5
        return Output(scores, {})


def two_heads(tested_head: str) -> Domains:
    given = {"split": "train", "view": "rgbt", "labels": "given"}
    source, target = Domain(**given, head="day"), Domain(**given, head="dark")
    return Domains(source=source, target=target, target_is="night", tested_head=tested_head)


@pytest.mark.parametrize(
    ("tested", "requested", "said", "by_day", "at_night"),
    [
        ("own", None, "own", 1, 2),
        ("source", None, "source", 1, 1),
        ("source", "own", "own", 1, 2),
        ("own", "source", "source", 1, 1),
        ("own", "target", "target", 2, 2),
    ],
)
def test_requested_head_predicts_and_is_recorded(  # noqa: PLR0913 - a case and places
    session: Session,
    tmp_path: Path,
    tested: str,
    requested: str | None,
    said: str,
    by_day: int,
    at_night: int,
) -> None:
    session = replace(session, model=Heads(), domains=two_heads(tested))
    found = written(session, tmp_path / "out", view="rgbt", threshold=0, head=requested)
    assert found.manifest["head"] == said
    for name, expected in zip(NAMES, (by_day, at_night, by_day), strict=True):
        assert np.unique(image(tmp_path / "out" / "labels" / f"{name}.png")).tolist() == [expected]
    for other in {"own", "source", "target"} - {said}:
        with pytest.raises(InputError, match=rf"another head \({said}, now {other}\)"):
            written(session, tmp_path / "out", view="rgbt", threshold=0, head=other)


def test_the_view_and_the_mode_of_the_network(session: Session, tmp_path: Path) -> None:
    session.model.train()
    written(session, tmp_path / "out", threshold=0, view="rgbt")
    assert set(session.model.seen) == {"rgbt"}
    assert not session.model.training
    # Red adds the image's number.
    assert np.array_equal(image(tmp_path / "out" / "labels" / f"{NAMES[2]}.png"), WHERE + 2)


def test_classes_are_mapped_after_the_argmax(session: Session, tmp_path: Path) -> None:
    # 0 and 3 become bump. Where 3 is predicted with 0.3, both together have 0.3 + 0.7 / 8.
    label_map = LabelMap(
        num_source=9, targets=CLASSES, groups={"bump": (0, 3), "car": (1, 2, 4, 5, 6, 7, 8)}
    )
    found = written(session, tmp_path / "out", threshold=0.35, label_map=label_map)
    label = image(tmp_path / "out" / "labels" / f"{NAMES[0]}.png")
    assert np.array_equal(label, np.choose(WHERE, [8, 1, 1, 255]))
    assert found.manifest["label_map"]["groups"]["bump"] == [0, 3]


def test_a_finished_folder_is_not_predicted_again(session: Session, tmp_path: Path) -> None:
    first = written(session, tmp_path / "out")
    calls = session.model.calls
    second = written(session, tmp_path / "out", teacher="the same, elsewhere")
    assert (second.manifest, session.model.calls) == (first.manifest, calls)


def test_missing_files_of_a_finished_folder_are_predicted(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = written(session, tmp_path / "out")
    session.model.calls = 0
    (tmp_path / "out" / "confidence" / f"{NAMES[1]}.png").unlink()

    def dies(*others: object) -> dict[str, str]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pseudo, "_predict", dies)
        with pytest.raises(KeyboardInterrupt):
            written(session, tmp_path / "out")
    assert not (tmp_path / "out" / "pseudo_labels.json").exists()
    second = written(session, tmp_path / "out")
    assert (second.digest, session.model.calls) == (first.digest, 1)


def test_images_come_from_the_cache(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where data.cache asks for one; labels are the same."""
    expected = written(session, tmp_path / "without")
    dataset = CachedDataset(session.dataset, tmp_path / "cache", num_threads=1)
    found = written(replace(session, dataset=dataset), tmp_path / "with")
    assert found.digest == expected.digest

    def refuses(name: str) -> None:
        raise AssertionError(f"{name} was decoded")

    monkeypatch.setattr(dataset.source, "read", refuses)
    assert [dataset.read(name).name for name in NAMES] == list(NAMES)


def test_killed_in_between_it_goes_on(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = written(session, tmp_path / "whole")
    out = tmp_path / "out"
    files: list[Path] = []

    def dies(path: Path, content: bytes) -> None:
        files.append(path)
        if len(files) == 5:  # settings, two files of the first image, one of the second
            path.with_name(f".{path.name}.1").write_bytes(content[:7])
            raise KeyboardInterrupt
        real(path, content)

    real = pseudo.write_atomic
    for module in (pseudo, images):
        monkeypatch.setattr(module, "write_atomic", dies)
    with pytest.raises(KeyboardInterrupt):
        written(session, out)
    with pytest.raises(InputError, match="is not complete"):
        PseudoLabels(out)
    for module in (pseudo, images):
        monkeypatch.setattr(module, "write_atomic", real)

    session.model.calls = 0
    found = written(session, out)
    assert session.model.calls == 2
    assert found.digest == whole.digest
    assert {**found.manifest} == {**whole.manifest}
    assert not list((out / "labels").glob(".*"))


def test_other_settings_are_refused(session: Session, root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    written(session, out)
    other_ids = LabelMap(num_source=9, targets=CLASSES, groups={"car": tuple(range(9))})
    others: dict[str, dict[str, Any]] = {
        "threshold (0.9, now 0.5)": {"threshold": 0.5},
        "split (train, now val)": {"split": "val"},
        "view (thermal, now rgbt)": {"view": "rgbt"},
        "label_map (None, now": {"label_map": other_ids},
    }
    for said, changes in others.items():
        with pytest.raises(InputError, match="holds pseudo-labels of another") as raised:
            written(session, out, **changes)
        assert said in str(raised.value)
    session.model.shift.data += 1
    with pytest.raises(InputError, match=r"another weights \([0-9a-f]{60}, now [0-9a-f]{60}\)"):
        written(session, out)
    session.model.shift.data -= 1
    with pytest.raises(InputError, match=r"another network \("):
        written(session_of(root, "transform.test_short_edge=8"), out)
    (out / "pseudo_labels.json").rename(out / "pseudo_labels.begun.json")
    with pytest.raises(InputError, match=r"another threshold \(0.9, now 0.5\)"):
        written(session, out, threshold=0.5)


def test_a_folder_that_holds_something_else_is_refused(session: Session, root: Path) -> None:
    before = (root / "labels" / f"{NAMES[0]}.png").read_bytes()
    with pytest.raises(InputError, match="holds images and no pseudo-labels"):
        written(session, root)
    assert (root / "labels" / f"{NAMES[0]}.png").read_bytes() == before


def test_two_processes_do_not_write_at_once(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    said: list[str] = []
    waits = threading.Event()
    monkeypatch.setattr(pseudo, "info", lambda sentence: (said.append(sentence), waits.set()))
    other = threading.Thread(target=written, args=(session, out))
    with holding(out / ".lock"):
        other.start()
        assert waits.wait(60)
        assert not (out / "labels").exists()
    other.join(60)
    assert PseudoLabels(out).manifest["images"] == 3
    assert "is being written by process" in said[0]


def test_the_digest_is_of_names_labels_and_confidences(session: Session, tmp_path: Path) -> None:
    out = tmp_path / "out"
    digest = hashlib.sha256()
    found = written(session, out)
    for name in NAMES:
        digest.update(f"{name} (4, 6)\n".encode())
        digest.update(image(out / "labels" / f"{name}.png").tobytes())
        digest.update(image(out / "confidence" / f"{name}.png").tobytes())
    assert found.digest == digest.hexdigest()


def test_images_that_cannot_be_read(root: Path, tmp_path: Path) -> None:
    (root / "images" / f"{NAMES[0]}.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=NAMES[0]):
        written(session_of(root), tmp_path / "raises")
    session = session_of(root, "data.on_error=skip")
    found = written(session, tmp_path / "skips")
    assert (found.manifest["images"], found.manifest["skipped"]) == (2, [NAMES[0]])
    calls = session.model.calls
    assert written(session, tmp_path / "skips").digest == found.digest
    assert session.model.calls == calls
    for name in NAMES:
        (root / "images" / f"{name}.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="no image could be read"):
        written(session_of(root, "data.on_error=skip"), tmp_path / "none")


def test_predictions_that_are_not_finite_are_refused(session: Session, tmp_path: Path) -> None:
    session.model.shift.data.fill_(float("nan"))
    with pytest.raises(RunError, match="'00001D': the network's class scores are NaN"):
        written(session, tmp_path / "out")


@pytest.fixture
def batch(session: Session) -> Iterator[Any]:
    from rgbt.data.loaders import eval_batches

    return iter(eval_batches(session.dataset, "train", session.transform, session.loading))


def test_probabilities_at_the_size_of_the_label(session: Session, batch: Any) -> None:
    full = next(batch).to("cpu")
    found = probabilities(session.model, full, session.fabric, "thermal")
    assert (found.shape, found.dtype) == ((2, 9, *HW), torch.float32)
    assert torch.allclose(found.sum(1), torch.ones(2, *HW))
    # Images of half the label's size: scores are enlarged, then normalised.
    small = replace(full, rgb=full.rgb[..., ::2, ::2], thermal=full.thermal[..., ::2, ::2])
    found = probabilities(session.model, small, session.fabric, "thermal")
    scores = session.model(small.rgb, small.thermal, ("thermal",)).logits
    enlarged = nn.functional.interpolate(scores, HW, mode="bilinear", align_corners=False)
    expected = enlarged.exp() / enlarged.exp().sum(1, keepdim=True)
    assert torch.allclose(found, expected, atol=1e-6)


def test_masks_of_queries_give_shares(session: Session, batch: Any) -> None:
    full = next(batch).to("cpu")
    found = probabilities(Constant([0.6, 0.2, 0.0], "masks"), full, session.fabric)
    assert torch.allclose(found[1, :, 2, 3], torch.tensor([0.75, 0.25, 0.0]))
    nothing = probabilities(Constant([0.0] * 3, "masks"), full, session.fabric)
    assert nothing.max() == 0


def test_each_image_is_predicted_by_its_head(session: Session, batch: Any) -> None:
    full = next(batch).to("cpu")
    found = probabilities(Heads(), full, session.fabric, heads=("day", "dark"))
    assert found.argmax(1)[:, 0, 0].tolist() == [1, 2]
