"""`rgbt align`: images, labels, masks, lists and the data set file that it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.align import Options, main
from rgbt.checks import InputError, RunError
from rgbt.config.overrides import built
from rgbt.data.check import check_dataset, misalignment
from rgbt.data.file_dataset import FileDataset, evenly_spaced
from rgbt.evaluation.alignment import read_rig
from rgbt.geometry.alignment import grid_of, moved
from tests.geometry.test_alignment import scene, thermal_of
from tests.geometry.warps import drawn_warp, mean_error

COMMON = (
    "dataset=folder",
    "dataset.num_classes=3",
    "dataset.classes=[ground,car,person]",
    "dataset.rgb='rgb/{name}.png'",
    "dataset.thermal='ir/{name}.png'",
    "dataset.label='gt/{name}.png'",
    "dataset.shares={train: 0.5, val: 0.25, test: 0.25}",
    "dataset.block=1",
)
WARP = drawn_warp(np.random.default_rng(8), scene(0))


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    """Eight pairs whose thermal image is warped by WARP; labels are drawn on RGB."""
    root = tmp_path / "own"
    for folder in ("rgb", "ir", "gt"):
        (root / folder).mkdir(parents=True)
    for number in range(8):
        image = scene(number)
        thermal = cv2.warpPerspective(
            thermal_of(image, number), WARP, (160, 120), borderMode=cv2.BORDER_REFLECT
        )
        cv2.imwrite(str(root / f"rgb/{number}.png"), np.dstack([image] * 3))
        cv2.imwrite(str(root / f"ir/{number}.png"), thermal)
        cv2.imwrite(str(root / f"gt/{number}.png"), (image > 128).astype(np.uint8) * 2)
    return [*COMMON, f"dataset.root={root}"]


def written(out: Path, name: str) -> np.ndarray:
    return np.asarray(cv2.imread(str(out / name), cv2.IMREAD_UNCHANGED))


def aligned_set(out: Path, monkeypatch: pytest.MonkeyPatch) -> FileDataset:
    monkeypatch.setenv("RGBT_CONF", str(out / "conf"))
    dataset = built("dataset", ["dataset=aligned"])
    assert isinstance(dataset, FileDataset)
    return dataset


def test_estimated_set_is_a_data_set(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    out = tmp_path / "aligned"
    assert main(Options(out=out), words) == 0
    said = capsys.readouterr().out
    assert "estimated from 8 pairs, 0 outliers" in said
    assert "ring 5" in said
    seen = np.mean(written(out, "valid/3.png") == 255)
    assert f"both cameras saw {seen:.0%} of the pixels" in said
    stored = json.loads((out / "alignment.json").read_text())
    assert mean_error(np.array(stored["H"]), WARP, scene(0)) < 0.4
    grid = grid_of((120, 160))
    before_px = np.sqrt(np.square(moved(np.array(stored["H"]), grid) - grid).sum(1).mean())
    assert stored["regions"][0]["before_px"] == pytest.approx(before_px)
    assert stored["regions"][0]["points"] == sum(r["points"] for r in stored["regions"][1:])
    before = built("dataset", words)
    dataset = aligned_set(out, monkeypatch)
    assert {s: dataset.names(s) for s in ("train", "val", "test")} == {
        s: before.names(s) for s in ("train", "val", "test")
    }
    report = check_dataset(dataset)
    assert report.problems == ()
    assert misalignment(dataset, report) == ""
    assert "px" in misalignment(before, check_dataset(before))
    # RGB stays; a label counts where thermal saw the pixel too.
    assert (written(out, "rgb/3.png") == written(tmp_path / "own", "rgb/3.png")).all()
    valid, label = written(out, "valid/3.png"), written(out, "labels/3.png")
    assert set(np.unique(valid)) == {0, 255}
    expected = written(tmp_path / "own", "gt/3.png")
    assert (label == np.where(valid == 255, expected, 255)).all()
    sheet = written(out, "worst.png")
    assert sheet.shape == (8 * 240, 4 * 320, 3)
    # What alignment.json holds gives the same images.
    again = tmp_path / "again"
    assert main(Options(out=again, matrix=out / "alignment.json"), words) == 0
    assert (written(again, "thermal/3.png") == written(out, "thermal/3.png")).all()


def test_labels_of_thermal_move_to_rgb(words: list[str], tmp_path: Path) -> None:
    """Thermal is 5 pixels to the right, and so are its labels."""
    file = tmp_path / "points.csv"
    file.write_text("x,y,u,v\n10,10,15,10\n100,10,105,10\n100,90,105,90\n10,90,15,90\n")
    out = tmp_path / "out"
    assert main(Options(out=out, points=file, labels="thermal"), words) == 0
    stored, label = written(tmp_path / "own", "gt/2.png"), written(out, "labels/2.png")
    assert (label[:, :155] == stored[:, 5:]).all()
    assert (label[:, 155:] == 255).all()
    thermal = written(tmp_path / "own", "ir/2.png")
    assert (written(out, "thermal/2.png")[:, :155] == thermal[:, 5:]).all()


def test_thermal_stays_and_rgb_moves(words: list[str], tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("10,10,15,10\n100,10,105,10\n100,90,105,90\n10,90,15,90\n")
    out = tmp_path / "out"
    assert main(Options(out=out, points=file, onto="thermal"), words) == 0
    own = tmp_path / "own"
    assert (written(out, "thermal/2.png") == written(own, "ir/2.png")).all()
    assert (written(out, "rgb/2.png")[:, 5:] == written(own, "rgb/2.png")[:, :-5]).all()
    assert (written(out, "labels/2.png")[:, 5:] == written(own, "gt/2.png")[:, :-5]).all()
    assert (written(out, "labels/2.png")[:, :5] == 255).all()


@pytest.mark.parametrize("unit", ["centikelvin", [0.01, -273.15]])
def test_unit_and_range_of_thermal_are_kept(
    unit: Any, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, out, file = tmp_path / "own", tmp_path / "out", tmp_path / "points.csv"
    for path in (own / "ir").iterdir():  # 10 to 35.5 degrees
        stored = written(own, f"ir/{path.name}").astype(np.uint16) * 10 + 28315
        cv2.imwrite(str(path), stored)
    file.write_text("10,10,15,10\n100,10,105,10\n100,90,105,90\n10,90,15,90\n")
    setting = f"dataset.thermal_range={{unit: {unit}, range: [12, 30]}}"
    assert main(Options(out=out, points=file), [*words, setting]) == 0
    before, dataset = built("dataset", [*words, setting]), aligned_set(out, monkeypatch)
    assert dataset.images.unit == before.images.unit
    assert dataset.images.limits == before.images.limits == pytest.approx((28515, 30315))
    name = before.names("test")[0]
    moved, own_levels = dataset.read(name).thermal, before.read(name).thermal
    assert (moved[:, :155] == own_levels[:, 5:]).all()


@pytest.mark.parametrize("onto", ["rgb", "thermal"])
def test_whole_numbers_that_a_png_cannot_hold(
    onto: Any, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values from -3000 to 4650 of 16 bits with a sign are written as real numbers."""
    own, out, file = tmp_path / "own", tmp_path / "out", tmp_path / "points.csv"
    for path in list((own / "ir").iterdir()):
        np.save(
            path.with_suffix(".npy"), written(own, f"ir/{path.name}").astype(np.int16) * 30 - 3000
        )
        path.unlink()
    file.write_text("10,10,15,10\n100,10,105,10\n100,90,105,90\n10,90,15,90\n")
    given = [*words, "dataset.thermal='ir/{name}.npy'", "dataset.thermal_range=[-2500,4000]"]
    assert main(Options(out=out, points=file, onto=onto), given) == 0
    before, after = (
        d.read("2").thermal for d in (built("dataset", given), aligned_set(out, monkeypatch))
    )
    if onto == "rgb":
        after, before = after[:, :155], before[:, 5:]
    assert (after == before).all()


def test_what_is_not_kept_of_another_data_set(tmp_path: Path, capsys: Any) -> None:
    file = tmp_path / "points.csv"
    file.write_text("10,10,15,10\n100,10,105,10\n100,90,105,90\n10,90,15,90\n")
    words = ["dataset=synth", "dataset.num_train=2", "dataset.num_val=1", "dataset.num_test=1"]
    assert main(Options(out=tmp_path / "out", points=file), words) == 0
    assert "has neither absent nor day and night of synth" in capsys.readouterr().err


def test_images_of_two_sizes_are_refused(words: list[str], tmp_path: Path) -> None:
    """H is in pixels: it would be wrong for an image of another size."""
    for kind in ("rgb", "gt"):
        path = tmp_path / f"own/{kind}/5.png"
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), -1), (80, 60)))
    file = tmp_path / "points.csv"
    file.write_text("10,10,15,10\n100,10,105,10\n100,90,105,90\n10,90,15,90\n")
    for options in ({"points": file}, {}):
        with pytest.raises(InputError, match="has another size than"):
            main(Options(out=tmp_path / "out", **options), words)


def test_link_out_of_the_root_is_not_copied(words: list[str], tmp_path: Path) -> None:
    link, out = tmp_path / "own/ir/2.png", tmp_path / "out"
    link.rename(tmp_path / "other.png")
    link.symlink_to(tmp_path / "other.png")
    file = tmp_path / "points.csv"
    file.write_text("10,10,15,10\n100,10,105,10\n100,90,105,90\n10,90,15,90\n")
    with pytest.raises(InputError, match=r"leads out of dataset\.root"):
        main(Options(out=out, points=file), words)
    assert not (out / "thermal/2.png").exists()


def test_matrix_of_plain_lists(tmp_path: Path) -> None:
    """As Python's json writes it: OpenCV itself writes maps of rows, columns and data."""
    file = tmp_path / "rig.json"
    file.write_text(json.dumps({"H": [[1, 0, 2.5], [0, 1, -3], [0, 0, 1]]}))
    (to_thermal, _), matrix = read_rig(file)
    assert matrix is not None
    assert np.allclose(to_thermal(np.array([[10.0, 20.0]])), [[12.5, 17]])


def test_files_that_are_refused(words: list[str], tmp_path: Path) -> None:
    file, out = tmp_path / "file", tmp_path / "out"
    for text, message in (
        ("1,2,3,4\n", "expected four lines or more"),
        ("1,2,3,4\n1,2,3\n", "3 at row 2"),
        ("x1,y1,x2,y2\n1,2,3,4\n1,2,3,four\n", "'four'"),
        ("1,2,3,4\n" * 4 + "1,2,3,inf\n", "expected four lines or more"),
        ("".join(f"{n},{n},{n},{n}\n" for n in range(5)), "not on one line"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            main(Options(out=out, points=file), words)
    for text, message in (
        ("not yaml [", "matrix="),
        ("%YAML:1.0\n---\na: 1\n", "'K_rgb'"),
        ('{"H": [[1, 0], [0, 1]]}', "H has 4 numbers, expected 9"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            main(Options(out=out, matrix=file), words)
    file.write_text('{"H": [[1, 0, 900], [0, 1, 0], [0, 0, 1]]}')
    with pytest.raises(InputError, match="both cameras saw no pixel"):
        main(Options(out=out, matrix=file), words)
    with pytest.raises(InputError, match="either dataset"):
        main(Options(out=out), [])
    with pytest.raises(InputError, match="holds the input images"):
        main(Options(out=tmp_path / "own"), words)
    assert not out.exists()


def test_night_without_edges_is_not_estimated(words: list[str], tmp_path: Path) -> None:
    for file in (tmp_path / "own/ir").iterdir():
        cv2.imwrite(str(file), np.full((120, 160), 9, np.uint8))
    with pytest.raises(RunError, match="cannot be estimated from 8 pairs"):
        main(Options(out=tmp_path / "out"), words)
    dataset = built("dataset", words)
    assert misalignment(dataset, check_dataset(dataset)).startswith(
        "alignment: cannot be estimated"
    )


def test_names_at_equal_distances() -> None:
    assert evenly_spaced("abcdefg", 4) == ["a", "c", "e", "g"]
    assert evenly_spaced("ab", 4) == ["a", "b"]


def folder_of_frames(folder: Path, places: np.ndarray) -> None:
    """A bright square of 8 pixels at these columns."""
    folder.mkdir()
    for number, place in enumerate(places):
        image = np.zeros((48, 96), np.uint8)
        cv2.rectangle(image, (int(place), 20), (int(place) + 8, 28), 255, -1)
        cv2.imwrite(str(folder / f"{number}.png"), np.dstack([image] * 3))


def test_two_videos_are_paired_by_motion(tmp_path: Path, capsys: Any) -> None:
    """RGB at 10 frames a second, thermal at 5; thermal began 1 s later."""
    steps = np.random.default_rng(2).integers(0, 6, 200)
    path = np.abs(np.cumsum(steps) % 160 - 80)  # forth and back
    folder_of_frames(tmp_path / "a", path[:100])
    folder_of_frames(tmp_path / "b", path[10:90:2])
    out = tmp_path / "out"
    given = Options(out=out, rgb=tmp_path / "a", thermal=tmp_path / "b", rgb_fps=10, thermal_fps=5)
    assert main(given, []) == 0
    said = capsys.readouterr().out
    assert "thermal began 1.0" in said
    assert "40 pairs of 100 RGB frames" in said
    for number in (0, 17, 39):
        rgb, thermal = (written(out, f"{kind}/{number:06d}.png") for kind in ("rgb", "thermal"))
        assert (rgb[..., 1] == thermal).all()
        assert rgb.shape == (48, 96, 3)
    dataset = built(
        "dataset",
        [
            "dataset=video",
            f"dataset.root={out}",
            "dataset.rgb='rgb/{name}.png'",
            "dataset.thermal='thermal/{name}.png'",
            "dataset.label=null",
        ],
    )
    assert len(dataset.names("test")) == 40
    assert dataset.read("000017").thermal.shape == (48, 96)


def test_videos_that_are_refused(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    film.write_text("#EXTM3U\nhttp://127.0.0.1/a.ts\n")
    with pytest.raises(InputError, match="expected a video in MP4"):
        main(Options(out=tmp_path / "out", rgb=film, thermal=film), [])
    palette = tmp_path / "palette"
    palette.mkdir()
    for number in range(3):
        cv2.imwrite(str(palette / f"{number}.png"), np.full((48, 96, 3), (0, 90, 200), np.uint8))
    rates: Any = {"rgb_fps": 5, "thermal_fps": 5}
    with pytest.raises(InputError, match="channels that differ by up to 200"):
        main(Options(out=tmp_path / "out", rgb=palette, thermal=palette, **rates), [])
    with pytest.raises(InputError, match="rgb_fps has no value"):
        main(Options(out=tmp_path / "out", rgb=tmp_path, thermal=film), [])
