"""Scores of methods: by region, under corruptions, by class of pairs of frames; and an equation."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.commands import DrawOptions
from analysis.figures import plots
from analysis.figures.inputs import Drawn, RunOptions, check_same_images, figure
from analysis.results import Evaluation, Levels, open_counts, row_of
from analysis.uncertainty import Resampling, estimate
from rgbt.checks import InputError, nearest, split_list
from rgbt.config.corruption_node import row_name
from rgbt.config.options import Help
from rgbt.metrics import names
from rgbt.metrics.counts import Counts, convention, scored_classes
from rgbt.metrics.measurement import CLEAN
from rgbt.metrics.metric import Absent, Regions
from rgbt.metrics.named import value
from rgbt.metrics.pairs import HEADLINES, Protocol, protocol_of
from rgbt.metrics.scores import class_mean, miou, tally
from rgbt.runs.folder import MetricLine, RunFolder
from rgbt.tables import class_labels
from rgbt.tracking.pictures import colour_limits

TITLES: dict[Protocol, str] = {
    "aligned": "virtual views, first frame warped into the second",
    "released": "virtual views, frames not warped (as released)",
    "next": "consecutive frames",
}
COLUMNS = 4
# Panels in a line of the figure of corruptions; inches of a line, and of the panel below them.
HEIGHT, HEIGHT_BELOW = 1.55, 1.35

# Title of the panel of corruptions without a severity.
MISSING = "one image missing"

# Regions over which bars of several methods stand side by side.
SPREAD = 0.3

# Panels of learning curves.
LOSS, VAL = "training loss", "validation mIoU (%)"

# Size of a heat map of regions in pixels.
MAP_HW = (480, 640)


@figure("temporal/fig5", "TC and CA of variants by class")
def consistency(
    given: RunOptions,
    *,
    frames: Annotated[
        Literal["aligned", "released", "next"],
        Help(
            "pairs of frames, counted by rgbt consistency: aligned or released (virtual views), or "
            "next (consecutive frames)"
        ),
    ] = "aligned",
) -> Drawn:
    """Draw TC and CA by class, of counts of pairs of frames (rgbt consistency)."""
    frame = class_consistency(given.counts(frames), given.absent)
    return draw_consistency(frame), frame


def class_consistency(
    methods: Mapping[str, Sequence[Counts]], absent: Absent | None
) -> pd.DataFrame:
    """Compute TC (value) and CA (low, by the union of the protocol) by class, means over seeds.

    Both are in percent; CA is never above TC. mean_tc and mean_ca are over the scored classes, the
    cells of the paper's Table I. InputError: counts of single frames, or of different kinds.
    """
    every = [counts for seeds in methods.values() for counts in seeds]
    reference, convened = check_same_images(every), absent or convention(every)
    protocol = protocol_of(reference.partition)
    if protocol is None:
        raise InputError(f"runs: {reference.partition} are counts of single frames.")
    labels = class_labels(reference.classes, reference.unscored)
    scored, rows = scored_classes(reference.classes, reference.unscored), []
    for label, seeds in methods.items():
        by_score = []
        for score in HEADLINES[protocol]:
            metrics = [names.of_class(name, score) for name in reference.classes]
            of_seeds = [[value(metric, counts, convened) for metric in metrics] for counts in seeds]
            by_score.append(np.mean(of_seeds, axis=0))
        tc, ca = by_score
        means = float(class_mean(tc, scored)), float(class_mean(ca, scored))
        for cells in zip(labels, tc, ca, strict=True):
            rows.append((protocol, label, *cells, *means))
    columns = ["protocol", "series", "tick", "value", "low", "mean_tc", "mean_ca"]
    return pd.DataFrame(rows, columns=columns).assign(high=math.nan)


@plots.styled
def draw_consistency(frame: pd.DataFrame) -> Figure:
    """Draw TC as full and CA as open marker, joined by a line; variants side by side."""
    made = plots.new_figure(plots.PAGE, 2.6)
    axes = made.subplots()
    protocol: Protocol = frame["protocol"][0]
    said = []
    for name, tc, ca in frame[["series", "mean_tc", "mean_ca"]].to_numpy():
        said.append(f"{name} (TC {tc:.1f}, CA {ca:.1f})")
    plots.dot_plot(axes, frame.assign(series=said), open_low=True)
    axes.set_ylim(bottom=0)
    union = " (released)" if HEADLINES[protocol][1] == names.CA_RELEASED else ""
    axes.set_ylabel(f"percent: TC full,\nCA{union} open")
    axes.set_title(TITLES[protocol], fontsize=plots.SMALL)
    plots.series_legend(made, axes, columns=frame["series"].nunique())
    return made


@figure("robustness", "mIoU under corruptions, one panel per corruption, one line per method")
def robustness(
    given: RunOptions,
    *,
    corruptions: Annotated[
        str, Help("corruptions to show, with commas: noise:rgb,frozen; default: all measured ones")
    ] = "",
    score: Annotated[
        Literal["mIoU", "relative"],
        Help("relative: in percent of what each training reaches on clean images"),
    ] = "mIoU",
) -> Drawn:
    """Draw means over trainings and bands of one standard deviation, after rgbt robustness."""
    rows = split_list(corruptions, "corruptions") if corruptions else []
    frame = corrupted(given.trainings(), given.absent, rows)
    return draw_robustness(frame, score), frame


def corrupted(
    methods: Mapping[str, Sequence[Levels]], absent: Absent | None, rows: Sequence[str] = ()
) -> pd.DataFrame:
    """Compute the scores of the trainings of methods under corruptions, called `rows`, or all.

    mIoU and relative are means over trainings, in percent, and in percent of what each training
    reaches on clean images; mIoU_sd and relative_sd standard deviations (n - 1; NaN of one).
    InputError: methods on other images or at different severities, or a row not measured.
    """
    every: list[tuple[str, int, Evaluation]] = []
    for method, seeds in methods.items():
        for number, levels in enumerate(seeds):
            every += [(method, number, level) for level in levels]
    all_counts = [level.counts for _, _, level in every]
    check_same_images(all_counts, alike=False)
    convened = absent or convention(all_counts)
    cells = []
    for method, number, level in every:
        score = 100 * miou(tally(level.counts.whole()), convened, level.counts.scored)
        of = level.counts.measurement
        row = row_of(level)
        about = row, of.title or (CLEAN if row == CLEAN else of.label), of.unit, of.severity
        cells.append((*about, method, number, float(score)))
    names_ = ["row", "title", "unit", "severity", "method", "training", "mIoU"]
    scores = _shown_rows(pd.DataFrame(cells, columns=names_), rows)
    clean = scores[scores["row"] == CLEAN].set_index(["method", "training"])["mIoU"]
    places = pd.MultiIndex.from_frame(scores[["method", "training"]])
    scores["relative"] = 100 * scores["mIoU"] / clean.reindex(places).to_numpy()
    keys = ["row", "title", "unit", "severity", "method"]
    found = scores.groupby(keys, sort=False, as_index=False).agg(
        seeds=("training", "size"),
        mIoU=("mIoU", "mean"),
        mIoU_sd=("mIoU", "std"),
        relative=("relative", "mean"),
        relative_sd=("relative", "std"),
    )
    # Points at which only some trainings of a method were measured are not shown.
    found = found[found["seeds"] == found["method"].map(clean.groupby("method").size())]
    if found.empty:
        raise InputError("runs: there is no corruption that all trainings were measured under.")
    return found


def _shown_rows(scores: pd.DataFrame, rows: Sequence[str]) -> pd.DataFrame:
    """Keep clean images and the chosen corruptions; refuse severities that differ (InputError)."""
    known = [row for row in scores["row"].unique() if row != CLEAN]
    shown = [row_name(row) for row in rows] or known
    for row in shown or [""]:
        if row not in known:
            raise InputError(f"corruptions: '{row}' was not measured; {nearest(row, known)}.")
    chosen = scores[scores["row"].isin([CLEAN, *shown])].copy()
    ladders = chosen[chosen["unit"] != ""].groupby(["row", "method", "training"])["severity"]
    for row, of_row in ladders.agg(list).groupby("row"):
        if of_row.map(str).nunique() > 1:
            found = "; ".join(f"{key[1]} {severities}" for key, severities in of_row.items())
            raise InputError(f"runs: {row} was measured at different severities: {found}.")
    return chosen


@plots.styled
def draw_robustness(frame: pd.DataFrame, score: str = "mIoU") -> Figure:
    """Draw one panel per corruption; the dashed line is the score on clean images.

    Corruptions without a severity, such as missing images, stand side by side below.
    """
    seeds = frame["seeds"].astype(str) + " seed" + np.where(frame["seeds"] > 1, "s", "")
    data = frame.assign(
        series=frame["method"] + " (" + seeds + ")",
        x=frame["severity"],
        value=frame[score],
        low=frame[score] - frame[f"{score}_sd"],
        high=frame[score] + frame[f"{score}_sd"],
        tick=frame["title"],
    )
    clean, others = data[data["row"] == CLEAN], data[data["row"] != CLEAN]
    order = clean["series"].tolist()
    curves, missing = [*others[others["unit"] != ""]["row"].unique()], others[others["unit"] == ""]
    has_below = int(len(missing) > 0)
    lines, columns = -(-len(curves) // COLUMNS), min(COLUMNS, max(1, len(curves)))
    width = plots.PAGE * max(columns, 2 + has_below) / COLUMNS
    made = plots.new_figure(width, HEIGHT * lines + HEIGHT_BELOW * has_below + 0.25)
    heights = [*[HEIGHT] * lines, *[HEIGHT_BELOW] * has_below]
    grid = made.add_gridspec(len(heights), columns, height_ratios=heights)
    first: Axes | None = None
    for index, row in enumerate([*curves, *[""] * has_below]):
        line, column = divmod(index, COLUMNS) if row else (lines, 0)
        axes = made.add_subplot(grid[line, column] if row else grid[line, :], sharey=first)
        first = first or axes
        panel = others[others["row"] == row] if row else missing
        panel = pd.concat([clean, panel]).sort_values(
            "series", key=lambda series: series.map(order.index), kind="stable"
        )
        for number, score_on_clean in enumerate(clean["value"]):
            colour = plots.series_style(number)["color"]
            axes.axhline(score_on_clean, color=colour, linestyle="--", linewidth=0.6, zorder=1)
        if row:  # dashes are for clean images
            plots.line_plot(axes, panel, {name: {"linestyle": "-"} for name in order})
            severities = panel["x"].unique()
            axes.set_xticks(severities, [f"{severity:g}" for severity in severities])
            axes.set_xlabel(panel["unit"].iloc[-1], fontsize=plots.SMALL)
        else:
            plots.dot_plot(axes, panel)
        title = panel["title"].iloc[-1] if row else MISSING
        room = width / columns if row else width
        axes.set_title(plots.folded(title, room - 0.3), fontsize=plots.SMALL)
        axes.tick_params(labelleft=column == 0)
        if column == 0:
            axes.set_ylabel("% of clean mIoU" if score == "relative" else "mIoU (%)")
    assert first is not None, "a figure has a panel"
    first.set_ylim(0, 1.08 * first.get_ylim()[1])
    plots.series_legend(made, first, columns=4)
    return made


@figure("regions/heat", "mIoU of each region as a heat map, one per method")
def region_heat(given: RunOptions) -> Drawn:
    """Paint regions by their mIoU."""
    frame = region_means(given.counts(), given.absent)
    return draw_heat(frame, MAP_HW), frame


@figure("regions/profile", "mIoU by region with intervals, one line per method")
def region_profile(given: RunOptions, drawn: DrawOptions) -> Drawn:
    """Draw mIoU over the regions with intervals over images, and over seeds where several."""
    frame = region_means(given.counts(), given.absent, drawn.settings())
    return draw_profiles(frame, drawn.level), frame


def region_means(
    methods: Mapping[str, Sequence[Counts]],
    absent: Absent | None,
    settings: Resampling | None = None,
) -> pd.DataFrame:
    """Compute mIoU by region (value) and of the image of methods, mean over seeds, in percent.

    Intervals are over images and seeds where there are several seeds, else over images; without
    `settings` there are none. InputError: counts that do not belong together.
    """
    every = [counts for seeds in methods.values() for counts in seeds]
    reference, convened, rows = check_same_images(every), absent or convention(every), []
    regions = [names.region(region) for region in range(1, reference.counts.shape[1] + 1)]
    for label, seeds in methods.items():
        kind = "both" if len(seeds) > 1 else "images"
        means = []
        for metric in (*regions, names.MIOU):
            of_seeds = [value(metric, counts, convened) for counts in seeds]
            means.append(float(np.mean(of_seeds)))
        ends, covers = [(math.nan, math.nan)] * len(regions), "nothing"
        if settings is not None:
            found = estimate(seeds, regions, replace(settings, absent=convened))
            intervals = [getattr(found[name], kind) for name in regions]
            if None not in intervals:
                ends = [(interval.low, interval.high) for interval in intervals]
                covers = "images and seeds" if kind == "both" else kind
        about = means.pop(), len(seeds), len(seeds[0].names), covers
        for region, (mean, bounds) in enumerate(zip(means, ends, strict=True), 1):
            rows.append((label, reference.partition, region, mean, *bounds, *about))
    columns = ["series", "partition", "x", "value", "low", "high"]
    return pd.DataFrame(rows, columns=[*columns, "mIoU", "seeds", "images", "covers"])


@figure("classes", "IoU by class, one bar per method")
def by_class(given: RunOptions) -> Drawn:
    """Draw IoU by class, means over seeds."""
    frame = class_means(given.counts(), given.absent)
    return draw_bars(frame, "IoU (%)"), frame


def class_means(methods: Mapping[str, Sequence[Counts]], absent: Absent | None) -> pd.DataFrame:
    """Compute IoU (value, percent) by class (tick) of methods (series), means over seeds.

    InputError: counts that do not belong together.
    """
    every = [counts for seeds in methods.values() for counts in seeds]
    reference, convened, rows = check_same_images(every), absent or convention(every), []
    labels = class_labels(reference.classes, reference.unscored)
    for name, label in zip(reference.classes, labels, strict=True):
        metric = names.class_iou(name)
        for method, seeds in methods.items():
            of_seeds = [value(metric, counts, convened) for counts in seeds]
            rows.append((method, label, float(np.mean(of_seeds)), len(seeds)))
    return pd.DataFrame(rows, columns=["series", "tick", "value", "seeds"])


def corruption_means(corrupted_: pd.DataFrame) -> pd.DataFrame:
    """Average the mIoU (value) of `corrupted` over severities: a tick per corruption."""
    shown = corrupted_.rename(columns={"method": "series", "title": "tick", "mIoU": "value"})
    return shown.groupby(["tick", "series"], sort=False, as_index=False)["value"].mean()


@plots.styled
def draw_bars(frame: pd.DataFrame, what: str, colours: Sequence[str] = ()) -> Figure:
    """Draw horizontal bars of `what` (`plots.bar_plot`), with a legend below."""
    many, ticks = frame["series"].nunique(), frame["tick"].nunique()
    # Up to three bars have numbers beside them.
    tall = max(0.2, many * (0.13 if many <= 3 else 0.07))
    made = plots.new_figure(plots.COLUMN, 0.7 + ticks * tall)
    axes = made.subplots()
    plots.bar_plot(axes, frame, colours)
    axes.set_xlabel(what)
    if not frame["value"].isna().all():
        axes.set_xlim(0, min(106.0, 1.12 * max(5.0, float(frame["value"].max()))))
    plots.series_legend(made, axes, columns=3)
    return made


@figure("curves", "training loss and validation mIoU over the steps, one line per run")
def curves(given: RunOptions) -> Drawn:
    """Draw what metrics.jsonl of runs holds; seeds of one method are lines of their own."""
    lines = {}
    for label, word in given.entries():
        for opened in open_counts(word, given.runs_dir, given.split):
            if opened.run is not None:
                name = label or opened.label
                name = name if name not in lines else f"{name} seed={opened.seed}"
                lines[name] = RunFolder(opened.run.folder, writes=False).lines()
    frame = curve_points(lines)
    return draw_curves(frame), frame


def curve_points(lines: Mapping[str, Sequence[MetricLine]]) -> pd.DataFrame:
    """Return loss and validation mIoU in percent (value; kind) over steps (x) of runs (series).

    InputError: there is nothing to draw.
    """
    rows = []
    for name, of_run in lines.items():
        for line in of_run:
            if line.kind == "train" and "loss" in line.values:
                rows.append((LOSS, name, line.step, line.values["loss"]))
            elif line.kind == "val" and names.MIOU in line.values:
                rows.append((VAL, name, line.step, 100 * line.values[names.MIOU]))
    if not rows:
        raise InputError("runs: their metrics.jsonl have no loss and no validation.")
    found = pd.DataFrame(rows, columns=["kind", "series", "x", "value"])
    return found.assign(low=math.nan, high=math.nan)


@plots.styled
def draw_curves(frame: pd.DataFrame) -> Figure:
    """Draw a panel for the loss and one for the validation below it, with a line for each run."""
    series, kinds = [*dict.fromkeys(frame["series"])], [*dict.fromkeys(frame["kind"])]
    made = plots.new_figure(plots.COLUMN, 0.3 + 1.35 * len(kinds))
    panels = made.subplots(len(kinds), 1, sharex=True, squeeze=False)[:, 0]
    styles = {name: plots.series_style(index) for index, name in enumerate(series)}
    for axes, kind in zip(panels, kinds, strict=True):
        marker = "." if kind == VAL else ""
        how = {name: {**style, "marker": marker} for name, style in styles.items()}
        plots.line_plot(axes, frame[frame["kind"] == kind], how)
        axes.set_ylabel(kind)
        if (frame[frame["kind"] == kind]["value"] >= 0).all():
            axes.set_ylim(bottom=0)
    panels[-1].set_xlabel("step")
    fullest = max(panels, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    plots.series_legend(made, fullest, columns=3)
    return made


@plots.styled
def draw_profiles(frame: pd.DataFrame, level: float) -> Figure:
    """Draw mIoU over the regions, a line per method, with the mIoU of the image in the legend.

    Intervals of one or two methods are bands; those of more are bars side by side, because bands
    would hide each other.
    """
    methods = frame.drop_duplicates("series")
    made = plots.new_figure(plots.COLUMN, 2.4 + plots.LINE * len(methods))
    axes = made.subplots()
    styles = {}
    for row in methods.itertuples():
        styles[str(row.series)] = {"label": f"{row.series} (mIoU {row.mIoU:.1f})"}
    is_crowded = len(methods) > 2
    plots.line_plot(axes, frame, styles, bars=is_crowded, spread=SPREAD * is_crowded)
    plots.region_axis(axes, frame["x"].max(), f"region ({frame['partition'][0]})")
    axes.set_ylabel("mIoU (%)")
    # The title says, for example, "95 % intervals over images and seeds", above their numbers.
    numbers = []
    for word, column in (("seed", "seeds"), ("image", "images")):
        counted = sorted(set(methods[column]))
        numbers.append(f"{' or '.join(map(str, counted))} {word if counted == [1] else column}")
    title = f"{100 * level:g} % intervals over {' or '.join(methods['covers'].unique())}"
    axes.set_title(f"{title}\n{', '.join(numbers)}", fontsize=plots.SMALL)
    plots.series_legend(made, axes, columns=1)
    return made


@plots.styled
def draw_heat(frame: pd.DataFrame, image_hw: tuple[int, int]) -> Figure:
    """Draw one (H, W) map per method with the mIoU of each region written into it."""
    methods = [*frame.groupby("series", sort=False)]
    low, high = colour_limits((frame["value"] / 100).tolist())
    region_map = map_of(frame["partition"][0], image_hw)
    height, width = image_hw
    columns = 2 if len(methods) == 4 else min(3, len(methods))
    rows = -(-len(methods) // columns)
    page = plots.COLUMN if columns == 1 else plots.PAGE
    panel = (page - 0.6) / columns
    titles = []
    for name, of_method in methods:
        folded = plots.folded(str(name), panel - 0.2)
        titles.append(f"{folded}\nmIoU {of_method['mIoU'].iloc[0]:.1f}")
    lines = 1 + max(title.count("\n") for title in titles)
    tall = rows * (panel * height / width + 0.06 + plots.LINE * lines)
    made = plots.new_figure(page, tall + 0.05)
    panels = made.subplots(rows, columns, squeeze=False).ravel()
    for axes, (_, of_method), title in zip(panels, methods, titles, strict=False):
        values = of_method["value"].to_numpy()
        numbers = ["-" if math.isnan(number) else f"{number:.1f}" for number in values]
        picture = values[region_map]
        shown: Any = plots.heat(axes, picture, region_map, numbers, panel, vmin=low, vmax=high)
        axes.set_title(title)
    for axes in panels[len(methods) :]:
        axes.set_axis_off()
    label = "mIoU of the region (%)"
    made.colorbar(shown, ax=[*panels], shrink=0.85, pad=0.015, label=label)
    return made


def map_of(partition: str, image_hw: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the map of a partition by the name in counts ("ring5", "ring9_released_3_4").

    Raises:
        InputError: no such partition, or an image too small for it.
    """
    match = re.fullmatch(r"(ring|vertical|horizontal)(\d+)(_released_3_4)?", partition)
    if match is None:
        raise InputError(f"runs: '{partition}' is not a partition of the image, such as ring5.")
    kind, number, released = match.groups()
    aspect = ("released_3_4" if released else "image") if kind == "ring" else None
    made = Regions(partition=kind, regions=int(number), aspect=aspect, absent="released")  # type: ignore[arg-type]
    return made.map(image_hw)


@figure("multihead/fig3", "gradients of entropy minimisation and maximum squares loss")
@plots.styled
def gradients() -> Drawn:
    """Draw both curves over the probability; analytic, without input."""
    frame = gradient_curves()
    made = plots.new_figure(plots.COLUMN, 2.3)
    axes = made.subplots()
    plots.line_plot(axes, frame, {name: {"marker": ""} for name in frame["series"].unique()})
    axes.set(xlim=(0, 1), xlabel="predicted probability", ylabel="gradient magnitude")
    axes.set_ylim(bottom=0, top=6)
    axes.legend(loc="upper center")
    return made, frame


def gradient_curves(points: int = 999) -> pd.DataFrame:
    """Compute the two gradients of one pixel with two classes of probability p and 1 - p.

        entropy          E = -(p log p + (1 - p) log(1 - p)) / log 2,  |dE/dp| = |log2(p / (1 - p))|
        maximum squares  M = -(p^2 + (1 - p)^2) / 2,                   |dM/dp| = |2 p - 1|

    Source: Multi-head, Eqs. (1) and (2) with C = 2 and one pixel, constants as printed there. The
    paper that Fig. 3 is taken from (Chen et al., ICCV 2019) leaves out 1 / log 2 and 1 / 2, which
    multiplies the curves by 0.69 and by 2; the forms, linear against unbounded, are the same.

    Returns:
        series, x (p, evenly inside (0, 1), because the entropy's gradient is infinite at the ends;
        of an odd number of points 0.5, where both vanish, is one) and value.
    """
    p = np.arange(1, points + 1) / (points + 1)
    curves = {
        "entropy minimisation": np.abs(np.log2(p / (1 - p))),
        "maximum squares": np.abs(2 * p - 1),
    }
    series = [pd.DataFrame({"series": name, "x": p, "value": v}) for name, v in curves.items()]
    return pd.concat(series, ignore_index=True).assign(low=math.nan, high=math.nan)
