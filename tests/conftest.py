"""Small data sets on disk in the layouts of MFNet, with contents that follow from the name."""

from __future__ import annotations

import fcntl
import gc
import hashlib
import os
import re
import signal
import sys

# One thread a process: two tests that share two cores otherwise wait for each other's threads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from functools import cache, lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.config import compose
from rgbt.files.atomic import write_atomic
from rgbt.randomness import numpy_generator
from rgbt.runs.run_spec import RunSpec
from rgbt.runtime.signals import WORDS
from tests import forked_python
from tests.commands import SPLITS, Call, Trained, without_pictures, words_of

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


def pytest_collection_finish() -> None:
    """Search less often for garbage, and never in what the collection made, which stays."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


@pytest.fixture(autouse=True)
def modules_of_the_reader() -> Iterator[None]:
    """Forget the reader's modules `my_lab`: every test has its own."""
    forget_reader()
    yield
    forget_reader()


def forget_reader() -> None:
    if "my_lab" in sys.modules:  # few tests have it, and there are thousands of modules
        for name in [name for name in sys.modules if name.partition(".")[0] == "my_lab"]:
            del sys.modules[name]


@pytest.fixture(scope="session", autouse=True)
def composed_by_any_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The processes of the suite share what Hydra has composed, a quarter of their time."""
    shared = shared_folder(tmp_path_factory) / "composed"
    shared.mkdir(exist_ok=True)
    alone = compose._by_hydra.__wrapped__

    def by_hydra(words: tuple[str, ...], own: str) -> bytes:
        if own:  # files of one test
            return alone(words, own)
        path = shared / hashlib.sha256(repr(words).encode()).hexdigest()
        if not path.exists():
            write_atomic(path, alone(words, own))
        compose.register_resolvers()  # as composing does
        return path.read_bytes()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compose, "_by_hydra", lru_cache(256)(by_hydra))
        yield


def shared_folder(factory: pytest.TempPathFactory) -> Path:
    """A folder of this call of pytest, whose processes share it."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


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
    rgb, thermal = (rng.integers(0, 256, each, dtype=np.uint8) for each in ((*hw, 3), hw))
    return rgb, thermal, rng.integers(0, 9, hw, dtype=np.uint8)


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
                images = {"images": np.dstack([rgb, thermal]), "labels": label}
            else:
                images = {"RGB": rgb, "Thermal": thermal, "Label": label}
            for folder, image in images.items():
                write_png(root / folder / f"{name}.png", image)
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


@pytest.fixture(scope="module")
def composed_once() -> Iterator[None]:
    """The runs of rows are composed once for a module, whatever folder they are in."""
    from sweeps.plan import planner

    once = cache(planner.specify_run)

    def specify(words: tuple[str, ...], *, checked: bool = True) -> RunSpec:
        return once(tuple(w for w in words if not w.startswith("runs_dir=")), checked=checked)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "specify_run", specify)
        yield


@pytest.fixture(scope="session")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Variables of `tests.forked_python.PYTHON`, whose programs start without importing."""
    with forked_python.server(tmp_path_factory.mktemp("forks")) as variables:
        yield variables


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """The folder of a run with these overrides, to be read or copied.

    Trained once in a call of pytest, whose processes share it. Runs on a data set that the
    overrides name share a folder of runs, and their upstream runs.
    """
    from rgbt.run import main
    from tests.composed import specified

    shared = shared_folder(tmp_path_factory) / "trained"

    def run(*overrides: str) -> Path:
        names_data = any(word.startswith("dataset=") for word in overrides)
        digest = hashlib.sha256(repr(overrides).encode()).hexdigest()[:12]
        place = shared / ("synthetic" if names_data else digest)
        place.mkdir(parents=True, exist_ok=True)
        words = words_of(place / "mf", place / "runs", *overrides)
        folder = specified(tuple(words)).folder
        with (place / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # until it is closed
            if not (folder / "result.json").exists():
                if not names_data:
                    write_data(place / "mf", SPLITS, (48, 64))
                with pytest.MonkeyPatch.context() as patch, without_pictures():
                    patch.setattr(sys, "argv", ["rgbt", *words])
                    with pytest.raises(SystemExit) as left:
                        main()
                assert not left.value.code
        return folder

    return run
