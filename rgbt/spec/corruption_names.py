"""Names of a corruption: ``noise:rgb`` on the command line, ``noise_rgb`` in files of counts."""

from __future__ import annotations


def row_name(corruption: str) -> str:
    """The name of a corruption in files of counts and rows of tables.

    Args:
        corruption: ``NAME`` or ``NAME:IMAGE`` with the image "rgb", "thermal" or "both", such as
            "noise:rgb".

    Returns:
        "noise_rgb"; "noise" of both images.
    """
    name, _, image = corruption.partition(":")
    if image in ("", "both"):
        return name
    # Counts of missing images have been called rgb_removed and thermal_removed on disk from the
    # start, and are found again by that name.
    return f"{image}_{name}" if name == "removed" else f"{name}_{image}"
