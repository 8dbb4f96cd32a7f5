"""Files of a download of PST900: the images and labels of both parts."""

from __future__ import annotations

from rgbt.data.prepare.copying import Item
from rgbt.data.prepare.plans import Download, Preparation, base_of
from rgbt.data.pst900_layout import FOLDERS, PARTS


def plan_pst900(download: Download) -> list[Item]:
    """RGB, thermal images and labels of both parts.

    Raises:
        InputError: no folder that holds train/rgb or test/rgb.
    """
    base = base_of(
        download.source,
        lambda has: any(has(f"{part}/{FOLDERS[0]}") for part in PARTS),
        "train/rgb or test/rgb of PST900",
    )
    folders = {f"{base}{part}/{kind}" for part in PARTS for kind in FOLDERS}
    return [
        Item(path.removeprefix(base), entry)
        for path, entry in download.source.entries.items()
        if path.rpartition("/")[0] in folders and path.endswith(".png")
    ]


PREPARATION = Preparation(plan_pst900, r"pst900.*\.zip")
