"""Predicting as a user does: class maps, pseudo-labels, networks of other classes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rgbt import predict
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.pseudo_labels import PseudoLabels
from tests.commands import SPLITS, Call, Trained, assert_one_sentence, short

PREDICT = predict.entry
ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))


def image(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.slow
def test_pseudo_labels_of_a_run(call: Call, trained: Trained, tmp_path: Path) -> None:
    folder, out = trained(*ONE), tmp_path / "pseudo"
    requested = (f"run={folder}", "input=train", f"out={out}", "pseudo_labels=true")
    code, said, err = call(PREDICT, *requested)
    assert code == 0, err
    table = said[said.index("8 images of mfnet train, every pixel") :]
    assert "unlabeled" in said
    assert str(out) in said
    manifest = PseudoLabels(out).manifest
    assert manifest["teacher"] == folder.name
    assert (manifest["view"], manifest["kept"], manifest["images"]) == ("rgbt", 1, 8)

    plain = tmp_path / "plain"
    assert call(PREDICT, f"run={folder}", "input=train", f"out={plain}")[0] == 0
    for name in SPLITS["train"]:
        label = image(out / "labels" / f"{name}.png")
        assert np.array_equal(label, image(plain / f"{name}.png"))
        confidence = image(out / "confidence" / f"{name}.png")
        assert confidence.dtype == np.uint16
        # The largest of nine probabilities is at least a ninth.
        assert confidence.min() >= 65535 // 9

    before = (out / "pseudo_labels.json").read_bytes()
    code, again, _ = call(PREDICT, *requested)
    assert (code, again) == (0, table)
    assert (out / "pseudo_labels.json").read_bytes() == before
    code, _, err = call(PREDICT, *requested, "threshold=0.9")
    assert code == 2
    assert_one_sentence(err, "holds pseudo-labels of another threshold (0.0, now 0.9)")


@pytest.mark.slow
def test_a_network_of_other_classes_needs_a_label_map(
    call: Call, data: Path, tmp_path: Path
) -> None:
    network = ("model=mfnet_tiny", "model.num_classes=14")
    model = build(compose([*network, "dataset=mfnet", f"dataset.root={data}"]).model)
    torch.save(model.state_dict(), tmp_path / "freiburg.pth")
    named = (
        *(*network, f"model.weights={tmp_path / 'freiburg.pth'}", f"dataset.root={data}"),
        *(f"runs_dir={tmp_path}", "data.num_workers=0", "trainer.threads=1", "input=val"),
        "trainer.accelerator=cpu",
    )
    out = tmp_path / "out"
    code, _, err = call(PREDICT, *named, f"out={out}", "pseudo_labels=true")
    assert code == 2
    assert_one_sentence(err, "model.num_classes is 14 but mfnet has 9 classes")
    assert "label_map=" in err

    for other in ("vistas_to_freiburg", "cityscapes_to_freiburg"):
        code, _, err = call(PREDICT, *named, f"out={out}", f"label_map={other}")
        assert code == 2
        assert_one_sentence(err, "classes, but model.num_classes is 14")

    mapped = (*named, "label_map=freiburg_to_mfnet")
    code, _, err = call(PREDICT, *mapped, f"out={out}", "pseudo_labels=true")
    assert code == 0, err
    manifest = json.loads((out / "pseudo_labels.json").read_text())
    assert manifest["teacher"] == "freiburg.pth"
    assert manifest["label_map"]["num_source"] == 14
    code, _, err = call(PREDICT, *mapped, f"out={tmp_path / 'plain'}")
    assert code == 0, err
    for name in SPLITS["val"]:
        label = image(out / "labels" / f"{name}.png")
        assert set(np.unique(label)) <= {0, 1, 2, 3, 4}
        assert np.array_equal(label, image(tmp_path / "plain" / f"{name}.png"))


def test_new_images_in_two_folders_or_two_files(
    call: Call, trained: Trained, data: Path, tmp_path: Path
) -> None:
    """What a run that was trained on packed files predicts of separate ones is the same."""
    run, new = f"run={trained(*ONE)}", tmp_path / "new"
    packed = image(data / "images" / "00201D.png")
    for folder, part in (("rgb", packed[..., :3]), ("thermal", packed[..., 3])):
        (new / folder).mkdir(parents=True)
        cv2.imwrite(str(new / folder / "00201D.png"), part)
    found = []
    for number, words in enumerate(
        (
            ("input=test",),
            (f"input={data / 'images' / '00201D.png'}",),
            (f"input={new}",),
            (f"rgb={new / 'rgb/00201D.png'}", f"thermal={new / 'thermal/00201D.png'}"),
        )
    ):
        out = tmp_path / f"out{number}"
        code, said, err = call(PREDICT, run, f"out={out}", *words)
        assert code == 0, err
        assert said.endswith(f"{3 if number == 0 else 1} images in {out}\n")
        found.append(image(out / "00201D.png"))
    assert all(np.array_equal(each, found[0]) for each in found)
