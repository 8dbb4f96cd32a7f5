"""Results by region of any method: ``rgbt score predictions=folder dataset=...``.

From a folder of predicted label images, or from the counts that a run has stored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from annotated_types import Interval

from analysis.commands import (
    MOST,
    DrawOptions,
    Regions,
    check_out,
    dataset_of,
    text_table,
    write_files,
)
from rgbt.checks import InputError, split_list
from rgbt.config.common_options import PredictionFormatOptions, RunsDir
from rgbt.config.options import Help
from rgbt.config.overrides import built
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics import names
from rgbt.metrics.metric import Absent
from rgbt.terminal import counting

if TYPE_CHECKING:  # --help answers without waiting for pandas and OpenCV
    import pandas as pd

    from analysis.predictions.scoring import FolderScores
    from analysis.uncertainty import Resampling
    from rgbt.metrics.counts import Counts
    from rgbt.tables import TextTable

    # Name of a method, its counts by one partition, and the classes that are its background.
    CountsOf = tuple[str, Counts, tuple[str, ...]]

# File in a folder of scores that records what was scored.
SOURCE = "source.txt"

COLUMNS = (
    *("method", "split", "partition", "subset", "images", "region", "class", "metric", "absent"),
    *("value", "low", "high"),
)
# Means in the tables; the file of scores holds more.
SHOWN = (names.MIOU, names.MACC, names.VAR)

# Options that have no effect on counts of runs.
PREDICTION_OPTIONS = ("regions", "resize", "name", "format", "palette", "prefix", "suffix")


@dataclass(frozen=True, kw_only=True)
class ScoreOptions(PredictionFormatOptions, DrawOptions):
    """Options of ``rgbt score``."""

    predictions: Annotated[
        str,
        Help(
            "folder of predictions, with a PNG file for every image of the split: class indices "
            "(8 bit, one channel) or, with format=colour, the colours of a palette"
        ),
    ] = ""
    counts: Annotated[
        str,
        Help(
            "instead of predictions: counts of runs, as run folder, config key, MLflow run id, "
            "file, or a list of these with commas"
        ),
    ] = ""
    split: Annotated[str, Help("split of the data set; default: test")] = ""
    regions: Regions = 5
    resize: Annotated[
        Literal["refuse", "nearest", "stretch"],
        Help(
            "predictions of another size than their label: refuse; nearest: resize them by the "
            "nearest pixel; stretch: so too where the ratio of height and width differs"
        ),
    ] = "refuse"
    name: Annotated[str, Help("name of the method in tables; default: name of the folder")] = ""
    background: Annotated[
        str,
        Help(
            "classes that are also left out in the table of other protocols, a list with commas; "
            "default: dataset.background, of counts that of their run"
        ),
    ] = ""
    out: Annotated[
        Path | None,
        Help(
            "output folder of counts_<partition>.npz, maps.npz, scores.md, scores.csv and "
            "protocols.csv; without it, the tables are only printed"
        ),
    ] = None
    runs_dir: RunsDir = Path("runs")
    resamples: Annotated[
        int, Interval(ge=0, le=MOST), Help("resamples for the intervals over images; 0: none")
    ] = 10_000

    @property
    def source(self) -> str:
        """What is scored, as the folder records it."""
        if self.counts:
            return f"counts={self.counts}"
        return f"predictions={Path(self.predictions).resolve()} split={self.split or 'test'}"


def main(options: ScoreOptions, overrides: list[str]) -> int:
    """Score predictions of any method by region, class, day and night, with intervals.

    Overrides choose the data set: dataset=mfnet dataset.root=/data/MFNet
    """
    import pandas as pd
    from rich.console import Group

    from analysis.protocols import protocol_scores, protocol_table
    from analysis.results import is_plain
    from rgbt.terminal import plain_text, print_rich, rich_table

    if bool(options.predictions) == bool(options.counts):
        raise InputError("predictions: expected either predictions=folder or counts=run.")
    out, settings = options.out, options.settings() if options.resamples else None
    _make_room(out, options.source)
    given = tuple(split_list(options.background, "classes")) if options.background else ()
    if options.counts:
        counted, remarks, where = _stored_counts(options, overrides), [], ""
    else:
        scored = _scored(options, overrides)
        counted = [(scored.name, counts, scored.background) for counts in scored.counts]
        remarks, where = scored.remarks(), scored.labels
        if out is not None:
            scored.save(out)
    frames, tables, protocols, other_tables = [], [], {}, []
    with counting("scoring", len(counted)) as advance:
        for name, counts, own in counted:
            frame = scores(name, counts)
            said = add_intervals(frame, counts, settings) if settings else ""
            frames.append(frame)
            tables += score_tables(frame, counts, said)
            if name not in protocols and is_plain(counts):  # partitions have the same sums
                protocols[name] = protocol_scores(name, counts, given or own)
                other_tables.append(protocol_table(protocols[name], counts, given or own, where))
            advance()
    tables += other_tables
    print_rich(Group(*map(rich_table, tables)))
    print_rich(plain_text("\n".join(remarks)))
    title = "# Scores of " + ", ".join(dict.fromkeys(name for name, *_ in counted))
    lines = [title, "", *(table.to_markdown() for table in tables), *remarks, ""]
    texts = {"scores.md": "\n".join(lines), SOURCE: f"{options.source}\n"}
    made = {"scores.csv": pd.concat(frames)}
    if protocols:
        made["protocols.csv"] = pd.concat(protocols.values())
    write_files(out, {**texts, **made})
    return 0


def scores(name: str, counts: Counts) -> pd.DataFrame:
    """Compute every score under both conventions for absent classes, one a row: `COLUMNS`.

    See `analysis.results.score_frame`; low and high are NaN.
    """
    import pandas as pd

    from analysis.results import score_frame

    sizes = {"all": len(counts.names)}
    for subset, part in counts.parts().items():
        sizes[subset] = len(part.names)
    both = [score_frame(counts, absent).assign(absent=absent) for absent in get_args(Absent)]
    frame = pd.concat(both, ignore_index=True)
    frame = frame.assign(method=name, split=counts.split, partition=counts.partition)
    frame = frame.assign(images=frame["subset"].map(sizes), low=float("nan"), high=float("nan"))
    return frame[[*COLUMNS]]


def conventions(frame: pd.DataFrame, counts: Counts) -> list[Absent]:
    """Return both where one of the means differs between them; else that of the counts alone."""
    means = frame[(frame["class"] == "") & frame["metric"].isin(SHOWN)]
    one, other = (means.loc[means["absent"] == absent, "value"] for absent in get_args(Absent))
    same = one.reset_index(drop=True).equals(other.reset_index(drop=True))
    return [counts.absent] if same else [*get_args(Absent)]


def add_intervals(frame: pd.DataFrame, counts: Counts, settings: Resampling) -> str:
    """Fill low and high of mIoU, also of regions, and of Var; say what the intervals are."""
    from analysis.uncertainty import estimate

    is_bounded = (frame["class"] == "") & frame["metric"].isin((names.MIOU, names.VAR))
    for absent in conventions(frame, counts):
        metrics = {}
        for row in frame[is_bounded & (frame["absent"] == absent)].itertuples():
            name = names.region(row.region) if row.region else str(row.metric)
            metrics[row.Index] = name if row.subset == "all" else names.subset(row.subset, name)
        found = estimate([counts], [*metrics.values()], replace(settings, absent=absent))
        for index, name in metrics.items():
            interval = found[name].images
            if interval is not None:
                frame.loc[index, ["low", "high"]] = interval.low, interval.high
    evidence = found[names.MIOU].evidence
    return (
        f"In brackets: {100 * settings.level:g} % intervals over images (Student, of Var without "
        f"its bias), {settings.resamples} resamples of {evidence.said}; none where there are too "
        f"few. {evidence.reason}"
    ).strip()


def score_tables(frame: pd.DataFrame, counts: Counts, said: str = "") -> list[TextTable]:
    """Show means and IoU of each class by region, accuracy of each class, and day and night.

    Means under both conventions for absent classes where these differ; classes without pixels "-".
    """
    import pandas as pd

    from rgbt.tables import class_labels, number

    shown = conventions(frame, counts)
    classes = dict(zip(counts.classes, class_labels(counts.classes, counts.unscored), strict=True))
    is_mean, is_whole = frame["class"] == "", frame["region"] == 0
    ending = " " + frame["absent"] if len(shown) > 1 else ""
    values = frame["value"].map(number)
    ends = frame.apply(lambda row: f" [{row['low']:.1f}, {row['high']:.1f}]", axis=1)
    cells = frame.assign(
        label=(frame["metric"] + ending).where(is_mean, frame["class"].map(classes)),
        column=("region " + frame["region"].astype(str)).where(~is_whole, "whole"),
        text=values + ends.where(frame["low"].notna(), ""),
    )
    is_all, metric = frame["subset"] == "all", frame["metric"]
    means = is_mean & metric.isin(SHOWN) & frame["absent"].isin(shown)
    by_class = is_all & ~is_mean & (frame["absent"] == "exclude")
    ious = [cells[is_all & means & (metric != names.VAR)], cells[by_class & (metric == "IoU")]]
    # The intervals of regions have a separate table; here they would be too wide.
    parts = cells.assign(
        label=frame["subset"] + " (" + frame["images"].astype(str) + ")" + ending,
        column=metric.where(is_whole, "IoU" + frame["region"].astype(str)),
        text=cells["text"].where(is_whole, values),
    )[means & (is_whole | (metric == names.MIOU))].sort_values("region", kind="stable")
    head = f"{frame['method'][0]}, {counts.split} ({len(counts.names)} images), {counts.partition}"

    def grid(title: str, rows: pd.DataFrame, *notes: str) -> TextTable:
        wide = rows.set_index(["label", "column"])["text"].unstack(sort=False)
        return text_table(f"{head}: {title}", wide.rename_axis(""), list(filter(None, notes)))

    return [
        grid("mIoU, mAcc and IoU of each class by region", pd.concat(ious)),
        grid("accuracy of each class by region", cells[by_class & (metric == "acc")]),
        grid("all images, day and night", parts, _about_absent(frame, counts), said),
    ]


def _about_absent(frame: pd.DataFrame, counts: Counts) -> str:
    scored = frame["class"].isin(set(counts.classes) - set(counts.unscored))
    gone = set(frame.loc[scored & frame["value"].isna(), "class"])
    absent = ", ".join(name for name in counts.classes if name in gone) or "no class"
    same = "" if len(conventions(frame, counts)) > 1 else "; the means agree"
    return (
        f"Without a pixel in some region or part: {absent}. released: it counts as 0; exclude: it "
        f"is left out of means{same}. The convention of the data set is absent={counts.absent}."
    )


def _make_room(out: Path | None, source: str) -> None:
    """Remove what an earlier call counted, because it would pass for a part of this one.

    Raises:
        InputError: the folder holds the scores of something else.
    """
    check_out(out)
    if out is None or not (out / "scores.csv").is_file():
        return
    noted = out / SOURCE
    earlier = noted.read_text(errors="replace").strip() if noted.is_file() else "another call"
    if earlier != source:
        raise InputError(f"out={out} holds the scores of {earlier}; give {source} its own folder.")
    for kind in ("counts_ring*", "counts_vertical*", "counts_horizontal*", "maps"):
        for path in out.glob(f"{kind}.npz"):
            path.unlink()


def _scored(options: ScoreOptions, overrides: list[str]) -> FolderScores:
    from analysis.predictions.scoring import score_folder

    dataset, split = dataset_of(overrides), options.split or "test"
    with counting("counting", len(dataset.names(split))) as advance:
        return score_folder(
            Path(options.predictions),
            dataset,
            split,
            regions=options.regions,
            given=options,
            resize=options.resize,
            name=options.name,
            absent=built("metric", overrides).absent,
            advance=advance,
        )


def _stored_counts(options: ScoreOptions, overrides: list[str]) -> list[CountsOf]:
    from analysis.results import open_counts

    default = ScoreOptions()
    idle = [key for key in PREDICTION_OPTIONS if getattr(options, key) != getattr(default, key)]
    idle += [word.partition("=")[0] for word in overrides]
    if idle:
        raise InputError(f"'{idle[0]}' has no effect on stored counts.")
    found = open_counts(options.counts, options.runs_dir, options.split)
    labels = [stored.label for stored in found]
    named = []
    for stored in found:
        label = stored.label
        if labels.count(label) > 1:
            label = str(stored.path) if stored.seed is None else f"{label} seed {stored.seed}"
        settings = stored.run.settings if stored.run else {}
        own = settings.get("dataset", {}).get("background") or ()
        background = tuple(name for name in stored.counts.classes if name in own)
        named.append((label, stored.counts, background))
    return named


entry = PlainCommand(ScoreOptions, main, heeds=("dataset",))

if __name__ == "__main__":
    entry()
