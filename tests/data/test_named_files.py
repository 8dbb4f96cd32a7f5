from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from rgbt.data.named_files import hash_of_files


def found(root: Path, **splits: tuple[str, ...]) -> str:
    return hash_of_files(splits, lambda name: [root / f"{name}.rgb", root / f"{name}.label"])


def test_hash_covers_splits_names_and_lengths(tmp_path: Path) -> None:
    (tmp_path / "a.rgb").write_bytes(b"123")
    (tmp_path / "a.label").write_bytes(b"")
    (tmp_path / "b.rgb").write_bytes(b"12345")
    expected = "test 1\nb [5, -1]\ntrain 2\na [3, 0]\nb [5, -1]\nval 0\n"
    splits = {"train": ("a", "b"), "val": (), "test": ("b",)}
    assert found(tmp_path, **splits) == sha256(expected.encode()).hexdigest()


def test_hash_tells_what_differs(tmp_path: Path) -> None:
    for name in "abc":  # alike but for their names
        (tmp_path / f"{name}.rgb").write_bytes(b"123")
        (tmp_path / f"{name}.label").write_bytes(b"1")
    hashes = [
        found(tmp_path, train=("a", "b"), test=("c",)),
        found(tmp_path, train=("a", "c"), test=("b",)),
        found(tmp_path, train=("b", "a"), test=("c",)),
        found(tmp_path, train=("a",), test=("b", "c")),
        found(tmp_path, train=("a", "b"), val=("c",)),
    ]
    (tmp_path / "a.label").write_bytes(b"12")
    hashes.append(found(tmp_path, train=("a", "b"), test=("c",)))
    (tmp_path / "a.label").unlink()
    hashes.append(found(tmp_path, train=("a", "b"), test=("c",)))
    assert len(set(hashes)) == len(hashes)
