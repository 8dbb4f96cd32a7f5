"""Tables of the statistics of one data set, and of two side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pandas as pd

from analysis.statistics.collect import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.sample import Sample, entropies
from analysis.tables import text_table
from rgbt.checks import InputError
from rgbt.tables import ABSENT, TextTable

VALUE = ["value", "low", "high"]

WIDEST = 12
"""More regions than this become rows."""

OF_CLASSES = {
    "class_occupancy": "by class, % of the pixels",
    "class_occupancy_normalised": "by class, % of its largest region (Fig. 3)",
}


def heading(stats: SpatialStatistics) -> str:
    """What was measured, in a line."""
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
    """The quantities by region, a table each; of noise by one `way` to estimate it, or by all."""
    titles = {
        "occupancy": "sample occupancy rate, % (Eq. 2)",
        **OF_CLASSES,
        "laplacian": f"Laplacian variance ({stats.kernel} neighbours, Eq. 3)",
        "noise": "noise, grey levels ({}; rounding alone is 0.29)",
        "snr": "signal to noise (Eq. 4; {}, {})",
        "label entropy": "label entropy, bits (Eq. 5)",
    }
    by_class = frame["quantity"].isin([*OF_CLASSES])
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
        for each, chosen in of_quantity:
            if way is None or all(one in ("", other) for one, other in zip(each, way, strict=True)):
                wide = chosen.set_index(["label", "region"])["value"].unstack(sort=False)
                wide = wide.assign(mean=wide.mean(axis=1, skipna=False))
                wide = wide if len(wide.columns) <= WIDEST + 1 else wide.T
                tables.append(text_table(title.format(*each), wide.rename_axis("")))
    return tables


def statement_table(frame: pd.DataFrame, level: float) -> TextTable:
    """A line per number of `analysis.statistics.statements.judged`, below its statement."""
    repeated = frame.duplicated(["key", "estimator", "average"])
    way = (", " + frame["estimator"] + ", " + frame["average"]).where(frame["estimator"] != "", "")
    shown = pd.DataFrame(
        {
            "statement": (frame["statement"] + way + " (" + frame["place"] + ")").mask(
                repeated, ""
            ),
            "verdict": frame["verdict"].mask(repeated, ""),
            "number": frame["contrast"],
            "value": frame["value"].map(digits),
            f"{100 * level:g} % interval": _intervals(frame),
            "stated": frame["wanted"],
            "alone": frame["finding"],
        }
    )
    title = "statements of SpatialSeg, Sec. III"
    return text_table(title, shown.set_index("statement"))


def estimator_table(frame: pd.DataFrame) -> TextTable:
    """How the numbers about noise depend on its estimator and on the average."""
    rows = frame[frame["estimator"] != ""]
    rows = rows.assign(
        way=rows["estimator"] + ", " + rows["average"],
        text=rows["value"].map(digits) + " " + rows["finding"],
    )
    wide = rows.set_index(["contrast", "wanted", "way"])["text"].unstack(sort=False)
    title = "how signal to noise depends on the estimator of the noise and on the average"
    return text_table(title, wide.rename_axis(["number", "stated"]))


def comparison_tables(
    samples: tuple[Sample, Sample], judged: tuple[pd.DataFrame, pd.DataFrame]
) -> list[TextTable]:
    """Levels of two data sets with their ratio, and the statements with the verdicts on both.

    The data sets are independent: the interval of a ratio combines the relative errors of both.

    Args:
        samples: the data set in question, and the one that it is compared with.
        judged: `analysis.statistics.statements.judged` of both.

    Raises:
        InputError: they differ in classes, background, regions, kernel or size of the images.
    """
    one, other = (each.stats for each in samples)
    for what in ("classes", "background", "partition", "kernel"):
        first, second = getattr(one, what), getattr(other, what)
        if first != second:
            raise InputError(f"against: {what} differ: {first} and {second}.")
    if one.region_map.shape != other.region_map.shape:
        sizes = f"{one.region_map.shape} and {other.region_map.shape}"
        raise InputError(f"against: the image sizes differ: {sizes}; set short_edge for both.")
    names = [f"{each.dataset}, {each.split}" for each in (one, other)]
    levels = [pd.DataFrame(_levels(each), columns=["what", *VALUE]) for each in samples]
    both = levels[0].merge(levels[1], on="what", suffixes=("", "_2"))
    first, second = both[VALUE], both[[f"{each}_2" for each in VALUE]].set_axis(VALUE, axis=1)
    reaches = [np.log(each["high"] / each["low"]) / 2 for each in (first, second)]
    ratio, factor = first["value"] / second["value"], np.exp(np.hypot(*reaches))
    ratios = pd.DataFrame({"value": ratio, "low": ratio / factor, "high": ratio * factor})
    shown = pd.concat([*map(_bounded, (first, second, ratios))], axis=1)
    shown = shown.set_axis([*names, "ratio"], axis=1)
    shown.index = pd.Index(both["what"], name="mean over regions")
    key = ["statement", "estimator", "average", "contrast", "wanted"]
    premises = judged[0].merge(judged[1], on=key, suffixes=("", "_2"))
    second = premises[[f"{each}_2" for each in VALUE]].set_axis(VALUE, axis=1)
    verdicts = pd.concat(
        [
            premises["wanted"],
            _bounded(premises) + " " + premises["finding"],
            _bounded(second) + " " + premises["finding_2"],
        ],
        axis=1,
    ).set_axis(["stated", *names], axis=1)
    verdicts.index = pd.Index(premises["statement"] + ": " + premises["contrast"], name="statement")
    title = "statements of SpatialSeg, Sec. III, on both data sets"
    return [text_table("levels of both data sets", shown), text_table(title, verdicts)]


def _levels(sample: Sample) -> Iterator[tuple[object, ...]]:
    """Every quantity that two data sets can share: name, value, and ends of its interval."""
    stats, labels = sample.stats, sample.mean(sample.stats.labels).sum(1)
    if stats.background:
        share = labels[:, ~stats.is_background].sum(1) / labels.sum(1)
        yield "occupancy, %", *sample.bounded(100 * share)
    for index in stats.objects:
        share = 100 * labels[:, index] / labels.sum(1)
        yield f"{stats.classes[index]}, % of the pixels", *sample.bounded(share)
    for index in stats.objects:
        shown = (stats.labels[:, :, index].sum(1) > 0).astype(float)
        yield f"{stats.classes[index]}, % of the images", *sample.bounded(100 * sample.mean(shown))
    word, background = entropies(stats)[-1]
    yield f"{word}, bits", *sample.bounded(sample.entropy(background=background).mean(1))
    for part in stats.subsets()[1:] or (ALL,):
        measures = {
            "mean, grey levels": sample.mean(stats.mean, part),
            "Laplacian variance": sample.laplacian(part),
            "noise, grey levels": sample.noise(part),
            "signal to noise": sample.snr(part),
        }
        for what, values in measures.items():
            for index, modality in enumerate(MODALITIES):
                level = sample.bounded(values[:, index].mean(1), part)
                yield f"{what}, {modality}, {part}", *level


def digits(value: float) -> str:
    """Three decimals, or two of what is larger than 10."""
    if math.isnan(value):
        return ABSENT
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.2f}"


def _intervals(frame: pd.DataFrame) -> pd.Series[str]:
    ends = "[" + frame["low"].map(digits) + ", " + frame["high"].map(digits) + "]"
    return ends.where(frame["low"].notna(), ABSENT)


def _bounded(frame: pd.DataFrame) -> pd.Series[str]:
    return frame["value"].map(digits) + " " + _intervals(frame)
