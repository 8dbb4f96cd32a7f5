"""Small data sets on disk in the layouts of MFNet, with contents that follow from the name."""

from __future__ import annotations

import gc
import os
import re
import signal
import sys

# One thread a process: two tests that share two cores otherwise wait for each other's threads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hydra._internal.hydra import Hydra

from rgbt.randomness import numpy_generator
from rgbt.runtime.signals import WORDS
from tests.commands import SPLITS, Call, Trained, only_run, without_pictures, words_of
from tests.quick_hydra import make_hydra_quick

WriteMFNet = Callable[..., Path]

# A suite started by nohup, or in the background of a script, inherits that these are ignored, and
# so would the commands that tests send them to.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Modules with a marker that is left out are not imported: some parse the documentation."""
    if collection_path.suffix != ".py":
        return None
    marker = re.search(r"^pytestmark = pytest\.mark\.(\w+)$", collection_path.read_text(), re.M)
    is_left_out = marker is not None and f"not {marker[1]}" in str(config.option.markexpr)
    return True if is_left_out else None


WRITES_NO_BYTECODE = sys.dont_write_bytecode


def pytest_collection() -> None:
    """Search for no garbage: the collection makes millions of objects that stay.

    Keep the compiled modules, also where images of containers forbid it: the processes that tests
    start would compile all of them again.
    """
    gc.disable()
    sys.dont_write_bytecode = False


def pytest_collection_finish() -> None:
    """Search for garbage again, but less often, and not in what the collection made.

    After a freeze Python takes the heap for a small one, and searched it for a tenth of the time.
    """
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)
    gc.enable()
    sys.dont_write_bytecode = WRITES_NO_BYTECODE


@pytest.fixture(scope="session", autouse=True)
def composed_once() -> Iterator[None]:
    """Hydra composes what it runs twice, first to see whether it is a grid: only searches are."""
    ask = Hydra.get_mode

    def get_mode(self: Hydra, config_name: str | None, overrides: list[str]) -> Any:
        names_one = any("search" in word or "hydra.mode" in word for word in overrides)
        return ask(self, config_name, overrides) if names_one else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hydra, "get_mode", get_mode)
        make_hydra_quick()
        yield


@pytest.fixture(scope="session", autouse=True)
def no_flush_to_disk() -> Iterator[None]:
    """No test cuts the power: thirty waits for the disk in each run would take as long as it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True)
def same_signal_handlers() -> Iterator[None]:
    """No command leaves a signal ignored, which later tests' processes would inherit."""
    before = {number: signal.getsignal(number) for number in WORDS}
    yield
    assert {number: signal.getsignal(number) for number in WORDS} == before


def pair(name: str, hw: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB, thermal, label of a name: noise that depends on the name alone."""
    rng = numpy_generator(0, name)
    rgb = rng.integers(0, 256, (*hw, 3), dtype=np.uint8)
    thermal = rng.integers(0, 256, hw, dtype=np.uint8)
    label = rng.integers(0, 9, hw, dtype=np.uint8)
    return rgb, thermal, label


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image given as R, G, B[, T] or one channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = image[..., [2, 1, 0, *range(3, image.shape[2])]]
    assert cv2.imwrite(str(path), np.ascontiguousarray(image))


def write_data(
    root: Path, splits: Mapping[str, list[str]], hw: tuple[int, int], layout: str = "packed"
) -> Path:
    for split, names in splits.items():
        root.mkdir(exist_ok=True)
        (root / f"{split}.txt").write_text("\n".join(names) + "\n")
        for name in names:
            rgb, thermal, label = pair(name, hw)
            if layout == "packed":
                write_png(root / "images" / f"{name}.png", np.dstack([rgb, thermal]))
                write_png(root / "labels" / f"{name}.png", label)
            else:
                write_png(root / "RGB" / f"{name}.png", rgb)
                write_png(root / "Thermal" / f"{name}.png", thermal)
                write_png(root / "Label" / f"{name}.png", label)
    return root


@pytest.fixture
def write_mfnet(tmp_path: Path) -> WriteMFNet:
    def write(
        splits: Mapping[str, list[str]],
        hw: tuple[int, int] = (24, 32),
        layout: str = "packed",
        folder: str = "mf",
    ) -> Path:
        return write_data(tmp_path / folder, splits, hw, layout)

    return write


@pytest.fixture
def expected_pair() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return pair


@pytest.fixture
def png() -> Callable[[Path, np.ndarray], None]:
    return write_png


@pytest.fixture
def pictures() -> None:
    """Requested by a test that reads the pictures of a run; other tests draw none."""


@pytest.fixture
def call(
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> Call:
    """Call a command's entry in this process: (exit code, stdout, stderr)."""
    drawn = "pictures" in request.fixturenames

    def run(entry: Callable[[], None], *arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["rgbt", *arguments])
        with nullcontext() if drawn else without_pictures(), pytest.raises(SystemExit) as left:
            entry()
        out, err = capfd.readouterr()
        return int(left.value.code or 0), out, err

    return run


@pytest.fixture
def data(write_mfnet: Callable[..., Path]) -> Path:
    return write_mfnet(SPLITS, hw=(48, 64))


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """The folder of a run with these overrides, on data equal to `data`; to be read or copied."""
    from rgbt.run import main

    made: dict[tuple[str, ...], Path] = {}

    def run(*overrides: str) -> Path:
        if overrides not in made:
            place = tmp_path_factory.mktemp("trained")
            data = write_data(place / "mf", SPLITS, (48, 64))
            words = ["rgbt", *words_of(data, place / "runs", *overrides)]
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(sys, "argv", words)
                with pytest.raises(SystemExit) as left:
                    main()
            assert not left.value.code
            made[overrides] = only_run(place / "runs")
        return made[overrides]

    return run
