from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.data.prediction_files import Affixes, find_affixes, opened_folder


def archive(path: Path, *names: str, content: bytes = b"x") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name in names:
            file.writestr(name, content)
    return path


def test_a_folder_stays_what_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "mine.zip"  # a folder may be called so
    folder.mkdir()
    with opened_folder(folder) as opened:
        assert opened == folder


def test_a_zip_file_leaves_nothing_outside_and_nothing_behind(tmp_path: Path) -> None:
    path = archive(tmp_path / "p.zip", "../../out/a.png", "../../out/b.png", "../../c.txt")
    with opened_folder(path) as folder:
        assert folder.name == "p"
        assert sorted(each.name for each in folder.rglob("*")) == ["a.png", "b.png"]
    assert not folder.exists()
    assert [each.name for each in tmp_path.rglob("*")] == ["p.zip"]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("a/1.png", "b/1.png"), r"found them in several folders \(a, b\); unpack it"),
        (("a/notes.txt",), "found them nowhere"),
    ],
)
def test_a_zip_file_without_one_folder_is_refused(
    tmp_path: Path, names: tuple[str, ...], message: str
) -> None:
    with (
        pytest.raises(InputError, match=message),
        opened_folder(archive(tmp_path / "p.zip", *names)),
    ):
        pass


def test_a_zip_file_with_two_files_of_one_name_is_refused(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = archive(tmp_path / "p.zip", "a/1.png", "a/2.png", "a/1.png")
    with pytest.raises(InputError, match="several files called 1.png"), opened_folder(path):
        pass


def test_an_encrypted_zip_file_is_refused_by_name(tmp_path: Path) -> None:
    path = archive(tmp_path / "p.zip", "a/1.png")
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\1\2") + 8] |= 1  # the flag of the entry
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"zip: a/1.png is encrypted; unpack"), opened_folder(path):
        pass


def test_a_damaged_zip_file_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "p.zip", "a.png", content=bytes(range(256)))
    content = bytearray(path.read_bytes())
    content[50] ^= 0xFF
    for damaged in (bytes(content), b"no archive"):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="cannot be read as a ZIP"), opened_folder(path):
            pass


def test_names_of_views_have_the_prefix_of_their_images() -> None:
    names = ("1", "1_view1", "11", "11_view1")
    stems = {f"Pred_w1_{name}" for name in names}
    assert find_affixes(stems, names, Affixes()) == ("Pred_w1_", "")
    assert find_affixes(set(names) | stems, names, Affixes()) == ("", "")
    assert find_affixes({"other"}, names, Affixes()) == ("", "")


def test_a_longer_number_is_another_image() -> None:
    assert find_affixes({"10001", "00012", "x0001"}, ["0001"], Affixes()) == ("", "")
    assert find_affixes({"out-0001.1"}, ["0001"], Affixes()) == ("out-", ".1")
