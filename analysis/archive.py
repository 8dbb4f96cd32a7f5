"""Keep the results of runs in the repository, one small file per finished run.

usage: rgbt archive add run=all, rgbt archive check, or rgbt archive rekey

``results/<key>.zip`` holds the configuration, the result, the provenance and the counts of a run on
the test images. What runs share is in ``results/shared/`` once: names of images and classes, pixels
of each label, and most words of a configuration. Of the counts a run then keeps the wrong
predictions only: the right ones are what is left of the labelled pixels. Unpacked, a run is a
folder that `rgbt.runs.result.RunResult` reads; its counts are equal, bit for bit. No file depends
on another run, so two machines that add runs never conflict.

Exit code 1 of ``check``: a run is damaged, its scores are not those of its counts, or its command
now has another key. No stored word is composed (`rgbt.runs.specify.request_again`).
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
import math
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from analysis.commands import Archive
from rgbt.checks import InputError, one_line
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import CommandGroup, PlainCommand
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import sealed, write_json
from rgbt.metrics.counts import MEASUREMENT, Counts
from rgbt.metrics.details import details_of
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.pairs import protocol_of
from rgbt.runs.folder import RunFolder, find_run, is_finished, read_result, runs_in
from rgbt.runs.result import RunResult, check_result
from rgbt.tables import TextTable
from rgbt.terminal import plain_text, print_rich, rich_table, warn

if TYPE_CHECKING:
    from rgbt.runs.run_spec import RunSpec

SHARED = "shared"
# Member with all texts of a run, which repeat most of those of another run in ``shared/``.
PACKED_TEXTS = "texts.json.z"

# LZMA without contexts (lc) and alignment (pb): bytes of equal significance follow each other.
BYTES = [{"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME, "lc": 0, "pb": 0}]

# Bytes that a member may unpack to; the largest of ours is below 1e7.
MOST = 10**9

PROVENANCE = (
    "started command git_commit git_dirty code python threads platform cpu cpu_usable gpus cuda"
)
# Archived entries of the provenance, and packages; paths are of no use on another machine.
PACKAGES = ("torch", "numpy", "opencv-python-headless", "lightning-fabric", "hydra-core", "optuna")


def archived(folder: Path) -> list[Path]:
    """All runs of an archive, by key: ``<key>.zip``, ``<key>-<digest>.zip`` with other results."""
    return sorted(folder.glob("*.zip"), key=lambda path: path.stem)  # the first results first


def key_of(path: Path) -> str:
    """Key of an archived run."""
    return path.stem.partition("-")[0]


def unpack(path: Path, folder: Path | None = None) -> RunResult:
    """An archived run as ``<digest of the file>/<key>`` in `folder` (None: the user's cache), once.

    InputError: a damaged file, or one that belongs to another run.
    """
    cache, key = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", key_of(path)
    folder = folder or Path(cache, "rgbt", "archive")
    target = folder / _digest(path.read_bytes()) / key
    if target.is_dir():
        return RunResult(target)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        unpacked = Path(scratch, "run")
        with _undamaged(path):
            _write_members(path, unpacked)
        result = RunResult(unpacked).result
        if result["key"] != key:
            raise InputError(f"{path} holds the run {result['key']}; rename the file.")
        target.parent.mkdir(exist_ok=True)
        try:
            unpacked.rename(target)
        except OSError:
            if not target.is_dir():  # another process was not faster
                raise
    return RunResult(target)


def _write_members(path: Path, folder: Path) -> None:
    members, shared = _members(path), path.parent / SHARED
    members |= _unpack_texts(members.pop(PACKED_TEXTS), shared)
    for name, content in members.items():
        file = folder / name.removesuffix(".xz")
        if not file.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"'{name}' leads out of the folder")
        file.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".npz.xz"):
            _unpack_counts(content, shared).save(file)
        else:
            write_atomic(file, content)


def add(run: RunResult, folder: Path) -> Path:
    """Put a finished run into the archive `folder`; the same results are written once.

    Further counts of the same results are added to the file. Other results of the same key, from
    another machine, are kept beside as ``<key>-<digest>.zip``.
    InputError: the run is not finished, one of its files is damaged, or its scores are not those of
    its counts.
    """
    if not run.is_finished:
        raise InputError(f"{run.folder} is not finished; rerun its command.")
    check_result(run)
    members = _packed(run, folder / SHARED)
    path = folder / f"{run.key}.zip"
    with _undamaged(path):
        old = _members(path) if path.exists() else {}
    if any(old[each] != members[each] for each in old.keys() & members if each.endswith(".xz")):
        content, old = _zipped(members), {}
        path = folder / f"{run.key}-{_digest(content)[:8]}.zip"
    if not path.exists() or members.keys() - old.keys():
        write_atomic(path, _zipped({**old, **members}))
    return path


def _members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        _check_size(sum(each.file_size for each in archive.infolist()))
        return {name: archive.read(name) for name in archive.namelist()}


def _check_size(size: int) -> None:
    if size > MOST:
        raise ValueError(f"it unpacks to more than {MOST} bytes")


def _decompressed(content: bytes) -> bytes:
    unpacker = lzma.LZMADecompressor()
    found = unpacker.decompress(content, MOST)
    _check_size(len(found) + (not unpacker.eof))
    return found


@contextmanager
def _undamaged(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # of any kind, by what is damaged
        raise InputError(f"{path} is damaged ({one_line(error)}).") from error


def _packed(run: RunResult, shared: Path) -> dict[str, bytes]:
    """The members of ``<key>.zip``; shared arrays are written to `shared`."""
    shared.mkdir(parents=True, exist_ok=True)
    paths = (path for name in ("config.yaml", "result.json") for path in run.folder.glob(name))
    texts = {path.name: path.read_bytes().decode() for path in paths}
    entries = [
        {name: entry.get(name) for name in PROVENANCE.split()}
        | {"packages": {name: entry.get("packages", {}).get(name) for name in PACKAGES}}
        for entry in run.provenance
    ]
    texts["provenance.json"] = json.dumps(sealed({"processes": entries}), indent=1)
    # Its parameters, for MLflow, are the configuration again.
    texts["run.json"] = json.dumps(sealed(vars(replace(run.description, params={}))))
    members = {PACKED_TEXTS: _packed_texts(json.dumps(texts).encode(), shared)}
    for name, measurement in run.measurements().items():
        if measurement.split != "val":  # no table reads those
            members[f"{name}.xz"] = _packed_counts(Counts.load(run.folder / name), shared)
    return members


def _zipped(members: Mapping[str, bytes]) -> bytes:
    """A file of members, equal for equal ones."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            how = zipfile.ZIP_DEFLATED if name.endswith(".json") else zipfile.ZIP_STORED
            archive.writestr(zipfile.ZipInfo(name), content, how)  # the time of an info is fixed
    return file.getvalue()


def _packed_texts(texts: bytes, shared: Path) -> bytes:
    """The name of other texts in ``shared/``, the first ones, and what `texts` have beyond them."""
    known = min(shared.glob("*.json"), default=shared / f"{_digest(texts)}.json")
    if not known.exists():
        write_atomic(known, texts)
    packer = zlib.compressobj(9, wbits=-zlib.MAX_WBITS, zdict=known.read_bytes())
    return known.stem.encode() + packer.compress(texts) + packer.flush()


def _unpack_texts(content: bytes, shared: Path) -> dict[str, bytes]:
    known = shared / f"{Path(content[:16].decode()).name}.json"
    unpacker = zlib.decompressobj(-zlib.MAX_WBITS, zdict=_checked(known.read_bytes(), known))
    texts = unpacker.decompress(content[16:], MOST)
    _check_size(len(texts) + len(unpacker.unconsumed_tail))
    return {name: text.encode() for name, text in json.loads(texts).items()}


def _packed_counts(counts: Counts, shared: Path) -> bytes:
    """LZMA of a JSON line and of the bytes of the counts, images last and by significance."""
    array = counts.counts
    arrays = {name: np.array(getattr(counts, name)) for name in ("names", "classes")}
    arrays["night"] = np.array(counts.night or (), bool)
    arrays["unscored"] = np.array(counts.unscored, str)
    # Details are no matrices, and the rows of triples are predictions.
    if details_of(counts.partition) is None and protocol_of(counts.partition) != "triples":
        array = array.copy()
        rows, right = _by_label(array, counts.partition)
        arrays["labelled"] = rows.sum(-1, dtype=np.int64)
        right[...] = 0
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    name = _digest(file.getvalue())
    if not (path := shared / f"{name}.npz.xz").exists():
        write_atomic(path, lzma.compress(file.getvalue(), preset=9))
    header = {"counts": [array.dtype.str, *array.shape], "shared": name}
    header[MEASUREMENT] = counts.measurement.to_json()
    images_last = np.moveaxis(array, 0, -1)
    is_there = images_last != 0  # most counts are 0: a bit each makes the file a sixth smaller
    planes = images_last[is_there].view(np.uint8).reshape(-1, array.itemsize).T
    body = np.packbits(is_there).tobytes() + planes.tobytes()
    return lzma.compress(json.dumps(header).encode() + b"\n" + body, filters=BYTES)


def _by_label(counts: NDArray[Any], partition: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Views of `counts`: all predictions of a label (..., K, P), and the right ones (..., K)."""
    classes = counts.shape[-1]
    if protocol_of(partition) is None:
        return counts, np.einsum("...cc->...c", counts)
    pairs = counts.reshape(len(counts), -1, classes + 1, classes, classes)[:, :, :-1]
    return pairs.reshape(*pairs.shape[:-2], -1), np.einsum("...ccc->...c", pairs)


def _unpack_counts(content: bytes, shared: Path) -> Counts:
    line, _, body = _decompressed(content).partition(b"\n")
    fields: dict[str, Any] = json.loads(line)
    arrays = _shared_arrays(shared, str(fields.pop("shared")))
    kind, images, *rest = fields.pop("counts")
    _check_size(math.prod((images, *rest)) * np.dtype(kind).itemsize)
    images_last = np.zeros((*rest, images), kind)
    bits, planes = np.split(np.frombuffer(body, np.uint8), [-(-images_last.size // 8)])
    is_there = np.unpackbits(bits, count=images_last.size).astype(bool).reshape(images_last.shape)
    flat = planes.reshape(images_last.itemsize, -1).T
    images_last[is_there] = np.ascontiguousarray(flat).view(kind).ravel()
    array = np.ascontiguousarray(np.moveaxis(images_last, -1, 0))
    measurement = Measurement.from_json(fields[MEASUREMENT])
    if "labelled" in arrays:
        rows, right = _by_label(array, measurement.partition)
        right[...] = arrays["labelled"] - rows.sum(-1)
    texts = {name: tuple(arrays[name].tolist()) for name in ("names", "classes", "unscored")}
    night = tuple(arrays["night"].tolist()) or None
    return Counts(counts=array, night=night, measurement=measurement, **texts)


def _shared_arrays(shared: Path, name: str) -> dict[str, NDArray[Any]]:
    """The arrays of a file that is named by the digest of its content."""
    file = shared / f"{Path(name).name}.npz.xz"
    content = _checked(_decompressed(file.read_bytes()), file)
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


def _checked(content: bytes, file: Path) -> bytes:
    if _digest(content) != file.name.partition(".")[0]:
        raise ValueError(f"shared/{file.name} does not match its digest")
    return content


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


# Commands.


@dataclass(frozen=True)
class AddOptions:
    """Options of `add_runs`."""

    run: Annotated[str, Help("run folder or config key; all: every finished run of runs_dir")]
    runs_dir: RunsDir = Path("runs")
    archive: Archive = Path("results")


@dataclass(frozen=True)
class ArchiveOptions:
    """Options of `check` and `rekey`."""

    archive: Archive = Path("results")


def add_runs(options: AddOptions, _: list[str]) -> int:
    """Add finished runs to the archive; a run that is in it already is left as it is."""
    folders = [run.path for run in runs_in(options.runs_dir) if is_finished(run.path)]
    if options.run != "all":
        folders = [find_run(options.run, options.runs_dir)]
    for folder in folders:
        added = add(RunResult(folder), options.archive)
        print_rich(plain_text(f"{added}  {added.stat().st_size} bytes"))
        if added.stem != key_of(added):
            warn(f"{options.archive / key_of(added)}.zip has other results; both are kept.")
    return 0


def check(options: ArchiveOptions, _: list[str]) -> int:
    """Compare every archived run with its counts, and its key with that of its command today."""
    found = list(_compared(options.archive))
    rows = [(path.stem, state, why) for path, state, why, _spec in found if state != "same"]
    if rows:
        print_rich(rich_table(TextTable("archive", ("run", "state", "reason"), tuple(rows))))
    good = len(found) - len(rows)
    print_rich(f"{len(found)} runs, {good} have the scores of their counts and today's key.")
    return int(bool(rows))


def rekey(options: ArchiveOptions, _: list[str]) -> int:
    """Rename runs whose configuration differs from today's in added settings alone.

    The default of an added setting has to keep the behaviour. Who adds it knows.
    """
    from omegaconf import OmegaConf

    for path, state, _reason, spec in list(_compared(options.archive)):
        if state != "added" or spec is None:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            folder = unpack(path, Path(scratch)).folder
            RunFolder(folder).write_config(OmegaConf.to_yaml(OmegaConf.create(dict(spec.plain))))
            write_json(folder / "result.json", {**(read_result(folder) or {}), "key": spec.key})
            for name, measurement in RunResult(folder).measurements().items():
                counts = Counts.load(folder / name)
                replace(counts, measurement=replace(measurement, run=spec.key)).save(folder / name)
            added = add(RunResult(folder.rename(folder.with_name(spec.key))), options.archive)
        path.unlink()
        print_rich(plain_text(f"{path}  ->  {added}"))
    return 0


# File, state, reason and what its command requests today. The state is "same" (key); "added"
# (another key, but only for settings that were added); "changed"; or "damaged".
Compared = tuple[Path, str, str, "RunSpec | None"]


def _compared(archive: Path) -> Iterator[Compared]:
    for path in track(archived(archive), "runs", console=Console(stderr=True), transient=True):
        try:
            with tempfile.TemporaryDirectory() as scratch, _undamaged(path):
                yield _compare(path, unpack(path, Path(scratch)))
        except InputError as error:
            yield path, "damaged", str(error), None


def _compare(path: Path, stored: RunResult) -> Compared:
    from rgbt.config.compose import flatten
    from rgbt.runs.run_spec import is_in_key
    from rgbt.runs.specify import request_again

    check_result(stored)
    spec = request_again(stored.settings, stored.description.overrides)
    before, now, none = flatten(stored.settings), flatten(spec.plain), object()
    keys = sorted(filter(is_in_key, before.keys() | now.keys()))
    differing = [key for key in keys if before.get(key, none) != now.get(key, none)]
    if not differing and (spec.names_files or spec.key == stored.key):
        return path, "same", "", spec
    # Nothing says how an upstream run differs. A key of a stranger's files is not computed.
    is_added = bool(differing) and all(key not in before for key in differing)
    is_added &= not spec.names_files
    reason = ", ".join(differing) or "a run that it depends on"
    return path, "added" if is_added else "changed", reason, spec


entry = CommandGroup(
    __doc__,
    {
        "add": PlainCommand(AddOptions, add_runs, heeds=(), name="rgbt archive add"),
        "check": PlainCommand(ArchiveOptions, check, heeds=(), name="rgbt archive check"),
        "rekey": PlainCommand(ArchiveOptions, rekey, heeds=(), name="rgbt archive rekey"),
    },
)

if __name__ == "__main__":
    entry()
