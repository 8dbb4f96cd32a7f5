"""Corruptions of time: the thermal image is delayed or frozen.

Frames are counted in the order of the split list, separately by day and by night if the data set
distinguishes them. A list that leaves frames out (as those of the published data sets do) makes a
step of one longer than the time between two frames of the camera.
"""

from __future__ import annotations

import math

from rgbt.checks import InputError
from rgbt.corruptions.corruption import Severities, check_ladder


class Delayed:
    """The thermal image is that of n frames earlier.

    The first n frames show the thermal image of the first one: there is none before it.

    Args:
        severities: n, at least 1.

    Raises:
        InputError: a severity out of range.
    """

    title = "delayed thermal"
    unit = "frames"

    def __init__(self, *, severities: Severities) -> None:
        self.severities = severities
        check_ladder(self)

    def check(self, severity: float) -> None:
        """Whole frames, at least 1."""
        if not (math.isfinite(severity) and severity >= 1 and severity == math.floor(severity)):
            raise InputError(f"severity counts frames: expected 1, 2, 3, ..., got {severity:g}.")

    def shown(self, index: int, severity: float) -> int:
        """Index of the frame whose thermal image is shown at `index`."""
        return max(0, index - int(severity))


class Frozen(Delayed):
    """The thermal image stands still and is renewed every n frames.

    Frame i shows the thermal image of frame ``i - i mod n``: one frame in n is right, the others
    are 1 to n - 1 frames old. The severity n is at least 2.
    """

    title = "frozen thermal"
    unit = "frames between two images"

    def check(self, severity: float) -> None:
        """Whole frames, at least 2: with 1 every frame is new."""
        super().check(severity)
        if severity < 2:
            raise InputError(
                "severity of frozen is the number of frames from one thermal image to the next, "
                "and 1 changes nothing; give 2 or more."
            )

    def shown(self, index: int, severity: float) -> int:
        """Index of the frame whose thermal image is shown at `index`."""
        return index - index % int(severity)
