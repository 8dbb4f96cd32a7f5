"""A full disk and exhausted memory: one sentence, exit code 1, nothing that was saved is lost."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import PngImagePlugin

from rgbt.checks import InputError
from rgbt.config.plain_command import PlainCommand
from rgbt.data.files import decode
from rgbt.files.atomic import write_atomic
from tests.commands import Call, NoOptions, assert_one_sentence, only_run, short, train

SMALL_MB = 2


def full() -> OSError:
    return OSError(errno.ENOSPC, "No space left on device")


def raising(error: Callable[[], BaseException]) -> Callable[[], None]:
    def main(options: NoOptions, overrides: list[str]) -> None:
        raise error()

    return PlainCommand(NoOptions, main)


def hidden() -> BaseException:
    """As PyTorch's writer has it: an error of its own, raised while the disk's was handled."""
    try:
        try:
            raise full()
        except OSError:
            raise RuntimeError("unexpected pos 2680384 vs 2680304")  # noqa: B904 - as there
    except RuntimeError as error:
        return error


@pytest.mark.parametrize("error", [full, hidden])
def test_full_disk_is_one_message(call: Call, error) -> None:
    code, _, err = call(raising(error))
    assert code == 1
    assert_one_sentence(err, "; free some space, then rerun the command to resume")


def test_message_that_hides_its_cause_stays(call: Call) -> None:
    def refused() -> None:
        try:
            raise full()
        except OSError:
            raise InputError("no shared memory in /dev/shm.") from None

    code, _, err = call(PlainCommand(NoOptions, lambda _, __: refused()))
    assert (code, err) == (2, "rgbt: no shared memory in /dev/shm.\n")


def of_torch() -> BaseException:
    with pytest.raises(RuntimeError) as told:
        torch.empty(2**52, dtype=torch.uint8)
    return told.value


@pytest.mark.parametrize(
    "error",
    [
        MemoryError,
        of_torch,
        lambda: torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.\nSee"),
        lambda: OSError(errno.ENOMEM, "Cannot allocate memory"),
    ],
)
def test_exhausted_memory_is_one_message(call: Call, error) -> None:
    code, _, err = call(raising(error))
    assert code == 1
    assert_one_sentence(err, "scale.crop_hw or data.num_workers, then rerun the command")


def test_other_errors_stay_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["rgbt"])
    with pytest.raises(RuntimeError, match="mat1 and mat2"):
        raising(lambda: RuntimeError("mat1 and mat2 shapes cannot be multiplied"))()


def test_sentences_hold_no_codes_of_the_terminal(call: Call) -> None:
    code, _, err = call(raising(lambda: InputError("\x1b[31mfolder\x07/a: is missing.")))
    assert (code, err) == (2, "rgbt: ?[31mfolder?/a: is missing.\n")


def test_an_image_that_does_not_fit_into_memory_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((8, 8, 3), np.uint8))

    def load(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load", load)
    with pytest.raises(MemoryError):
        decode(path)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of a few megabytes."""
    if os.geteuid() != 0:
        pytest.skip("only root may mount a file system")
    place = tmp_path / "small"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SMALL_MB}m", "tmpfs", str(place)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("this container may not mount a file system")
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def test_what_was_whole_before_the_disk_was_full_stays_whole(small_disk: Path) -> None:
    noise = np.random.default_rng(0).bytes(2 * SMALL_MB * 2**20)
    write_atomic(small_disk / "a.json", b"old")
    with pytest.raises(OSError, match="No space left"):
        write_atomic(small_disk / "a.json", noise)
    assert (small_disk / "a.json").read_bytes() == b"old"


@pytest.mark.slow
def test_a_training_whose_disk_fills_up_resumes_when_there_is_space(
    call: Call, data: Path, small_disk: Path, tmp_path: Path
) -> None:
    runs = small_disk / "runs"
    words = ("+experiment=grbm", "scale.max_steps=4", *short(4))
    # Room for the first checkpoint, and not for the next one beside it.
    subprocess.run(["mount", "-o", "remount,size=50m", str(small_disk)], check=True)
    code, _, err = train(call, data, runs, *words)
    assert code == 1
    assert_one_sentence(err, "No space left on device")
    (folder,) = runs.iterdir()
    assert (folder / "last.pt").is_file()
    assert not (folder / "result.json").exists()
    subprocess.run(["mount", "-o", "remount,size=300m", str(small_disk)], check=True)
    code, _, err = train(call, data, runs, *words)
    assert (code, "resumes at step 2" in err) == (0, True), err
    straight = tmp_path / "straight"
    assert train(call, data, straight, *words)[0] == 0
    first, second = (only_run(each) / "counts_test.npz" for each in (runs, straight))
    np.testing.assert_array_equal(np.load(first)["counts"], np.load(second)["counts"])
