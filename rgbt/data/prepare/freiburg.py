"""Files of a download of Freiburg Thermal: images and labels of both archives."""

from __future__ import annotations

import re

from rgbt.checks import InputError
from rgbt.data.freiburg_layout import LABEL, RGB, TEST_LABEL, TEST_RGB, TEST_THERMAL, THERMAL
from rgbt.data.prepare.copying import Item
from rgbt.data.prepare.download import SourceFile
from rgbt.data.prepare.plans import Download, Preparation, add_once

TRAIN = re.compile(
    rf"(?:^|/)(seq_[^/]*)/([^/]+)/({RGB}|{THERMAL}|{LABEL})/([^/]+\.png)$",
    re.IGNORECASE,
)
TEST = re.compile(
    rf"(?:^|/)test(?:/[^/]+)?/(day|night)/"
    rf"({TEST_RGB}|{TEST_THERMAL}|{TEST_LABEL})/([^/]+\.(?:png|npy))$",
    re.IGNORECASE,
)


def plan_freiburg(download: Download) -> list[Item]:
    """RGB images, aligned thermal images and labels of the training and of the test archive.

    Raises:
        InputError: neither part is there, or two files would become one.
    """
    found: dict[str, SourceFile] = {}
    for path, entry in download.source.entries.items():
        for part, pattern in (("train", TRAIN), ("test", TEST)):
            match = pattern.search(path)
            if match is not None:
                add_once(found, "/".join([part, *match.groups()]), entry)
    if not found:
        raise InputError(
            f"source: {download.source.path} holds neither train/seq_*/*/{RGB} nor "
            f"test/day/{TEST_RGB} of Freiburg Thermal; give the folder that holds "
            "train.zip and test.zip, or one of these archives."
        )
    return [Item(target, entry) for target, entry in found.items()]


PREPARATION = Preparation(plan_freiburg, r"(train|test)\.zip")
