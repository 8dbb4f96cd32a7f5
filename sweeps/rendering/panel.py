"""One panel of a table's figure: our values and the published ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OURS, PUBLISHED = "#0072B2", "#D55E00"
"""Blue and vermilion of Okabe and Ito, which colour-blind eyes tell apart."""

FAR_APART = 2.0
"""Two sets of values get an axis each where the gap between them is this many times their range."""


@dataclass(frozen=True)
class Series:
    """Values along an axis; NaN: there is none.

    Attributes:
        places: where they stand.
        means: values.
        sds: half lengths of the error bars; NaN: none.
    """

    places: tuple[float, ...]
    means: tuple[float, ...]
    sds: tuple[float, ...]

    def known(self) -> list[float]:
        """The values that there are."""
        return [mean for mean in self.means if not math.isnan(mean)]


def are_far_apart(ours: Sequence[float], theirs: Sequence[float]) -> bool:
    """Whether one axis for both would press each into a line."""
    if not ours or not theirs:
        return False
    gap = max(min(ours) - max(theirs), min(theirs) - max(ours))
    widest = max(max(ours) - min(ours), max(theirs) - min(theirs))
    return gap > FAR_APART * widest and gap > 0


def draw_pair(
    axes: Axes, ours: Series, theirs: Series, *, across: bool, joined: bool
) -> tuple[Axes, Axes]:
    """Both series in one panel; the axes of ours and of the published values.

    Args:
        axes: the panel.
        ours: our values.
        theirs: the published ones.
        across: values run to the right and places down, instead of values up.
        joined: draw lines between the points of a series.
    """
    other = axes
    if are_far_apart(ours.known(), theirs.known()):
        other = axes.twiny() if across else axes.twinx()
        side, second = ("x", "top") if across else ("y", "right")
        axes.tick_params(axis=side, colors=OURS)  # type: ignore[arg-type]
        other.tick_params(axis=side, colors=PUBLISHED)  # type: ignore[arg-type]
        other.spines[second].set_color(PUBLISHED)
        other.set(**{f"{side}label": "published"})
        getattr(other, f"{side}axis").label.set_color(PUBLISHED)
    line = "-" if joined else "none"
    style: dict[str, Any] = {"fmt": "o", "ms": 5, "lw": 1, "capsize": 3}
    named = [(axes, ours, OURS, "ours", OURS), (other, theirs, PUBLISHED, "published", "none")]
    for target, series, colour, label, face in named:
        if not series.known():
            continue
        values, places = series.means, series.places
        bars = None if all(map(math.isnan, series.sds)) else series.sds
        x, y = (values, places) if across else (places, values)
        xerr, yerr = (bars, None) if across else (None, bars)
        marker = style | {"ls": line, "color": colour, "mfc": face, "label": label}
        target.errorbar(x, y, yerr, xerr, **marker)
    axes.grid(axis="x" if across else "y", alpha=0.25)
    return axes, other


def title_and_legend(figure: Figure, title: str) -> None:
    """A title above all panels, and below them one legend for all."""
    figure.suptitle(title, fontsize=10)
    handles: dict[str, Artist] = {}
    for axes in figure.axes:
        artists, labels = axes.get_legend_handles_labels()
        handles |= dict(zip(labels, artists, strict=True))
    labels = list(handles)
    artists = list(handles.values())
    figure.legend(artists, labels, loc="outside lower center", ncols=4, fontsize=8)
