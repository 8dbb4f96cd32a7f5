"""How near `rgbt align` comes to a known homography, on embedded scenes and on MFNet's images.

python -m tests.benchmarks.bench_alignment
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rgbt.config.overrides import built
from rgbt.geometry.alignment import Alignment, estimated
from rgbt.geometry.optical_flow import gray_of
from tests.geometry.warps import Image, Matrix, drawn_warp, inner, mean_error, warped

SHARED = Path(os.environ.get("RGBT_SHARED", Path(__file__).resolve().parents[3] / "shared"))
REAL = SHARED / "realdata"

Pairs = list[tuple[Image, Image]]


def read(words: Sequence[str], split: str, number: int | None = None) -> dict[str, Pairs]:
    """Pairs by day ("D") and at night ("N")."""
    dataset = built("dataset", words)
    names = dataset.names(split)
    chosen = {time: [name for name in names if name.endswith(time)] for time in "DN"}
    found = {
        time: [dataset.pair(name) for name in names[:number]] for time, names in chosen.items()
    }
    return {
        time: [(gray_of(sample.rgb), sample.thermal) for sample in samples]
        for time, samples in found.items()
    }


def is_used(found: Alignment | None, image: Image) -> bool:
    return found is not None and not found.reason(inner(image).shape)


def native(pairs: Pairs) -> Matrix | None:
    """The alignment of pairs as they are, None if it is not used."""
    found = estimated([(inner(rgb), inner(thermal)) for rgb, thermal in pairs])
    return found.matrix if found is not None and is_used(found, pairs[0][0]) else None


def trials(what: str, groups: list[Pairs], limit: float, own: list[Matrix | None]) -> None:
    """Print how many of the groups, each warped alike, come within `limit` pixels."""
    generator = np.random.default_rng(62)
    errors, silent = [], 0
    for pairs, before in zip(groups, own, strict=True):
        image = pairs[0][0]
        warp = drawn_warp(generator, image)
        found = estimated([(inner(rgb), warped(thermal, warp)) for rgb, thermal in pairs])
        if found is None or before is None or not is_used(found, image):
            silent += 1
        else:
            errors.append(mean_error(found.matrix, warp @ before, image))
    good = sum(error <= limit for error in errors)
    worst = f"median {np.median(errors):.2f}, largest {max(errors):.2f} px" if errors else ""
    print(
        f"| {what} | {len(groups)} | {good} | {len(errors) - good} | {silent} | {worst} |",
        flush=True,
    )


def main() -> None:
    print("| pairs | trials | within | beyond | no estimate | error |\n|---|---|---|---|---|---|")
    for time, pairs in read(["dataset=synth", "dataset.num_test=60"], "test", 10).items():
        same: list[Matrix | None] = [np.eye(3)] * 10
        trials(f"embedded {time}, one scene, 0.5 px", [[pair] for pair in pairs], 0.5, same)
        trials(f"embedded {time}, ten scenes, 0.5 px", [pairs] * 10, 0.5, same)
    if not REAL.is_dir():
        return
    root = [f"dataset.root={REAL / name}" for name in ("mfnet200", "mfnet20")]
    train, val = (read(["dataset=mfnet", root[0]], split) for split in ("train", "val"))
    real = read(["dataset=mfnet", root[1]], "test")
    for time, pairs in real.items():
        singles = [[pair] for pair in pairs]
        trials(f"MFNet {time}, one pair, 1.5 px", singles, 1.5, [native(pair) for pair in singles])
        trials(f"MFNet {time}, ten pairs, 1.5 px", [pairs] * 10, 1.5, [native(pairs)] * 10)
    both = [*real["D"], *real["N"]]
    trials("MFNet, all twenty, 1.5 px", [both] * 10, 1.5, [native(both)] * 10)
    others = [pair for time in "DN" for pair in [*train[time], *val[time]][::8]]
    what = "MFNet, all twenty against 26 of other drives, 1.5 px"
    trials(what, [both] * 10, 1.5, [native(others)] * 10)


if __name__ == "__main__":
    main()
