"""Tables of the statistics of a data set."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from analysis.commands import text_table
from analysis.statistics.collect import ALL, SpatialStatistics
from rgbt.tables import ABSENT, TextTable

# Most regions that become columns; more become rows.
WIDEST = 12

# What the images at hand say about a statement: it is of the paper's images, not of these.
HERE = {"holds": "as stated", "contradicted": "not so", "undecided": "not shown"}

CLASS_QUANTITIES = {
    "class_occupancy": "by class, % of the pixels",
    "class_occupancy_normalised": "by class, % of its largest region (Fig. 3)",
}


def heading(stats: SpatialStatistics) -> str:
    """Say what was measured, in a line."""
    hw = stats.region_map.shape
    nights = "" if stats.night is None else f" ({int(stats.night.sum())} at night)"
    ignored = float(stats.ignored.sum() / max(1, stats.ignored.sum() + stats.labels.sum()))
    return (
        f"{stats.dataset}, split {stats.split}: {len(stats.names)} images{nights} of "
        f"{hw[0]}x{hw[1]}, {stats.partition}, {100 * ignored:.2f} % of the pixels ignored"
    )


def region_tables(
    frame: pd.DataFrame, stats: SpatialStatistics, way: tuple[str, str] | None = None
) -> list[TextTable]:
    """Make a table of each quantity by region; of noise by one `way` to estimate it, or by all."""
    titles = {
        "occupancy": "sample occupancy rate, % (Eq. 2)",
        **CLASS_QUANTITIES,
        "laplacian": f"Laplacian variance ({stats.kernel} neighbours, Eq. 3)",
        "noise": "noise, grey levels ({}; rounding alone is 0.29)",
        "snr": "signal to noise (Eq. 4; {}, {})",
        "label entropy": "label entropy, bits (Eq. 5)",
    }
    by_class = frame["quantity"].isin([*CLASS_QUANTITIES])
    objects = frame["class"].isin([stats.classes[index] for index in stats.objects])
    rows = frame[~by_class | (objects & (frame["part"] == ALL))]
    labels = rows[["modality", "part"]].agg(", ".join, axis=1).str.removeprefix(", ")
    what = rows["quantity"].str.partition("entropy ")[2]  # with or without background
    labels = labels.where(what == "", labels + ", " + what).where(~by_class, rows["class"])
    factor = np.where(by_class[rows.index] | (rows["quantity"] == "occupancy"), 100, 1)
    rows = rows.assign(
        label=labels,
        region="R" + rows["region"].astype(str),
        quantity=rows["quantity"].str.partition(" w")[0],
        value=rows["value"] * factor,
    )
    tables = []
    for name, title in titles.items():
        of_quantity = rows[rows["quantity"] == name].groupby(["estimator", "average"], sort=False)
        for of_noise, chosen in of_quantity:
            if way is not None and of_noise not in (("", ""), (way[0], ""), way):
                continue
            wide = chosen.set_index(["label", "region"])["value"].unstack(sort=False)
            wide = wide.assign(mean=wide.mean(axis=1, skipna=False))
            wide = wide if len(wide.columns) <= WIDEST + 1 else wide.T
            tables.append(text_table(title.format(*of_noise), wide.rename_axis("")))
    return tables


def statement_table(frame: pd.DataFrame, level: float) -> TextTable:
    """Show each number of `analysis.statistics.statements.judged` below its statement."""
    repeated = frame.duplicated(["key", "estimator", "average"])
    way = (", " + frame["estimator"] + ", " + frame["average"]).where(frame["estimator"] != "", "")
    statements = frame["statement"] + way + " (" + frame["place"] + ")"
    shown = pd.DataFrame(
        {
            "statement": statements.mask(repeated, ""),
            "on these images": frame["verdict"].map(HERE).mask(repeated, ""),
            "number": frame["contrast"],
            "value": frame["value"].map(digits),
            f"{100 * level:g} % interval": _intervals(frame),
            "stated": frame["wanted"],
            "alone": frame["finding"].map(HERE),
        }
    )
    title = "statements of SpatialSeg, Sec. III"
    return text_table(title, shown.set_index("statement"))


def estimator_table(frame: pd.DataFrame) -> TextTable:
    """Show how the numbers about noise depend on its estimator and on the average."""
    rows = frame[frame["estimator"] != ""]
    rows = rows.assign(
        way=rows["estimator"] + ", " + rows["average"],
        text=rows["value"].map(digits) + " " + rows["finding"].map(HERE),
    )
    wide = rows.set_index(["contrast", "wanted", "way"])["text"].unstack(sort=False)
    title = "how signal to noise depends on the estimator of the noise and on the average"
    return text_table(title, wide.rename_axis(["number", "stated"]))


def digits(value: float) -> str:
    """Write three decimals, or two of what is larger than 10."""
    if math.isnan(value):
        return ABSENT
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.2f}"


def _intervals(frame: pd.DataFrame) -> pd.Series[str]:
    ends = "[" + frame["low"].map(digits) + ", " + frame["high"].map(digits) + "]"
    return ends.where(frame["low"].notna(), ABSENT)
