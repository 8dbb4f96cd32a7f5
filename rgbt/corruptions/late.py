"""A thermal camera that does not keep pace with the colour camera.

Frames are counted in the order of the split list; by day and by night apart where the data set
tells them apart. A list that leaves frames out (as those of the published data sets do) makes a
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
        """See `rgbt.corruptions.corruption.OfTime`."""
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
                "severity of frozen counts the frames from one thermal image to the next: 1 is "
                "no corruption; give 2 or more."
            )

    def shown(self, index: int, severity: float) -> int:
        """See `rgbt.corruptions.corruption.OfTime`."""
        return index - index % int(severity)
