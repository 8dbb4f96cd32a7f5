"""Find the predictions of a method: a folder or a ZIP file, and how the files are named.

Released code writes NAME.png, Pred_WEIGHTS_NAME.png, WEIGHTS_NAME.png or NAME_pred.png.
"""

from __future__ import annotations

import re
import tempfile
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from rgbt.checks import InputError, one_line

OVERLAY = "_overlay"
"""Ending of the pictures that `rgbt.predict` writes beside its predictions."""


class Affixes(NamedTuple):
    """What is before and after the name of an image in the name of its prediction."""

    prefix: str = ""
    suffix: str = ""

    def file_stem(self, name: str) -> str:
        """Name of the prediction without ".png"."""
        return f"{self.prefix}{name}{self.suffix}"

    @property
    def sentence(self) -> str:
        """One sentence about the names; "" where they are those of the images."""
        return f"Files are named {self.file_stem('NAME')}.png." if any(self) else ""


def find_affixes(stems: Collection[str], names: Sequence[str], given: Affixes) -> Affixes:
    """How the predictions of the images are named.

    A prefix ends and a suffix begins with a separator such as "_": 100001 is no file of 00001.

    Args:
        stems: names of the files, without ".png".
        names: of the images.
        given: by the user; ("", "") where the user gives none.

    Returns:
        `given` where it is not empty; the names of the images alone where a file has one; else the
        only prefix and suffix with the largest number of files.

    Raises:
        InputError: two prefixes or suffixes with equally many files.
    """
    if any(given) or any(name in stems for name in names):
        return given
    own = [stem for stem in stems if not stem.endswith(OVERLAY)]
    for name in filter(None, names):
        found = {
            Affixes(stem[: match.start()], stem[match.end() :])
            for stem in own
            for match in re.finditer(rf"(?<![^\W_]){re.escape(name)}(?![^\W_])", stem)
        }
        if found:
            return _most_frequent(found, set(own), names)
    return given


def _most_frequent(found: set[Affixes], stems: set[str], names: Sequence[str]) -> Affixes:
    counts = Counter({each: sum(each.file_stem(name) in stems for name in names) for each in found})
    first, *others = counts.most_common()
    tied = sorted(each for each, number in others if number == first[1])
    if not tied:
        return first[0]
    both = sorted([first[0], tied[0]])
    ways = [
        " ".join(f"{key}={value}" for key, value in each._asdict().items() if value)
        for each in both
    ]
    raise InputError(
        f"{first[1]} of {len(names)} images have several files, such as "
        f"{both[0].file_stem('NAME')}.png and {both[1].file_stem('NAME')}.png; choose one with "
        f"{ways[0]} or {ways[1]}."
    )


@contextmanager
def opened_folder(path: Path) -> Iterator[Path]:
    """The folder of predictions; that of a ZIP file is temporary.

    Only the PNG files of the archive are written, under their last names, so that none can leave
    the temporary folder.

    Args:
        path: a folder, or a file with the ending ".zip".

    Raises:
        InputError: a damaged or encrypted archive, two files of one name, or PNG files of several
            folders.
    """
    if path.suffix.lower() != ".zip" or path.is_dir():
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="rgbt-predictions-") as made:
        folder = Path(made) / path.stem
        folder.mkdir()
        try:
            _extract(path, folder)
        except (
            zipfile.BadZipFile,
            zlib.error,
            OSError,
            NotImplementedError,
            RuntimeError,
        ) as error:
            raise InputError(
                f"{path} cannot be read as a ZIP file ({one_line(error)}); download or pack it "
                "again, or give the folder of its predictions."
            ) from error
        yield folder


def _extract(path: Path, folder: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        entries = [
            each
            for each in archive.infolist()
            if each.filename.lower().endswith(".png") and not _is_hidden(each.filename)
        ]
        if locked := next((each for each in entries if each.flag_bits & 1), None):
            raise InputError(
                f"{path}: {locked.filename} is encrypted; unpack it with its password and give the "
                "folder."
            )
        folders = sorted({str(PurePosixPath(each.filename).parent) for each in entries})
        if len(folders) != 1:
            few = f"in several folders ({', '.join(folders[:3])})" if folders else "nowhere"
            raise InputError(
                f"{path}: expected the PNG files of one folder, found them {few}; unpack it and "
                "give one folder."
            )
        names = Counter(PurePosixPath(each.filename).name for each in entries)
        if twice := next((name for name, count in names.items() if count > 1), None):
            raise InputError(
                f"{path} holds several files called {twice}; pack it again with one of each."
            )
        for each in entries:
            (folder / PurePosixPath(each.filename).name).write_bytes(archive.read(each))


def _is_hidden(name: str) -> bool:
    """Whether it is of the folder __MACOSX, or a hidden file."""
    path = PurePosixPath(name)
    return "__MACOSX" in path.parts or path.name.startswith(".")
