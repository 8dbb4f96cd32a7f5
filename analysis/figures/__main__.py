"""Command that draws a figure of the papers: ``rgbt figures figure=spatialseg/fig5``.

Without ``figure=`` it lists all figures and what each is made from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Interval

from analysis.arguments import MOST, Blocks
from rgbt.checks import InputError, check_choice
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

Count = Annotated[int, Interval(ge=1, le=MOST)]


@dataclass(frozen=True)
class Options:
    """The figure, and what single figures take (`analysis.figures.catalogue`)."""

    figure: Annotated[
        str, Help('name, e.g. spatialseg/fig5; "list" shows all of them with what each needs')
    ] = "list"
    out: Annotated[str, Help("file to write; .pdf, .svg or .png (300 dots per inch)")] = ""
    maps: Annotated[str | None, Help("folder (or its maps.npz) of rgbt score")] = None
    statistics: Annotated[
        str | None,
        Help("folder (or its statistics.npz) of rgbt spatial; or dataset=... to measure it now"),
    ] = None
    methods: Annotated[
        str | None,
        Help(
            "label:folder,label:folder; what rgbt score wrote (spatialseg/fig2, fig3), or "
            "predicted label images (qualitative panels)"
        ),
    ] = None
    runs: Annotated[
        str | None,
        Help(
            "runs, groups or files of counts, with commas; label:run,label:run names them, and "
            "entries with one label are seeds of one method"
        ),
    ] = None
    runs_dir: Annotated[str | None, Help("folder of runs (runs)")] = None
    frames: Annotated[
        Literal["aligned", "released", "next"] | None,
        Help(
            "pairs of frames of temporal/fig5: aligned or released (virtual views), or next "
            "(consecutive frames), as rgbt consistency counts them"
        ),
    ] = None
    split: Annotated[
        str | None,
        Help(
            "split of the data set or of the runs (test; for statistics: train); a file that holds "
            "another one is refused"
        ),
    ] = None
    part: Annotated[Literal["all", "day", "night"] | None, Help("all, day or night")] = None
    names: Annotated[str | None, Help("images to show, with commas")] = None
    pick: Annotated[
        Literal["first", "largest_difference"] | None,
        Help("instead: rule, first or largest_difference between the first and the last method"),
    ] = None
    rows: Annotated[Count | None, Help("number of images (4)")] = None
    layout: Annotated[
        Literal["rows", "columns"] | None, Help("rows or columns: one row, or column, per image")
    ] = None
    format: Annotated[
        Literal["auto", "index", "colour"] | None,
        Help("of predictions: auto, index or colour"),
    ] = None
    suffix: Annotated[str | None, Help("of predictions: NAME<suffix>.png")] = None
    regions: Annotated[
        Count | None, Help("number of regions of each partition of spatialseg/fig2 (5)")
    ] = None
    absent: Annotated[
        Literal["released", "exclude"] | None,
        Help("how a class without pixels counts: released (0) or exclude; default: as counted"),
    ] = None
    estimator: Annotated[
        Literal["immerkaer", "wavelet_mad", "std"] | None,
        Help("of the noise: immerkaer, wavelet_mad or std"),
    ] = None
    average: Annotated[
        Literal["pooled", "images"] | None, Help("of signal to noise: pooled or images")
    ] = None
    patches: Annotated[
        tuple[Count, ...] | None, Help("sizes of the patches of crm/fig5 (8,16,32,64)")
    ] = None
    seed: Annotated[Annotated[int, Interval(ge=0, le=MOST)] | None, Help("of the masks (0)")] = None
    band: Annotated[
        Literal["widest", "images", "seeds", "both"] | None,
        Help("interval over: widest, images, seeds or both"),
    ] = None
    resamples: Annotated[Count | None, Help("of that interval (10000)")] = None
    level: Annotated[float | None, Help("of that interval (0.95)")] = None
    blocks: Blocks | None = None
    size: Annotated[
        str | None, Help("of the picture of regions/heat (480x640), 16 to 4096 pixels a side")
    ] = None
    corruptions: Annotated[
        str | None,
        Help("to show, with commas (robustness): noise:rgb,frozen; default: all that exist"),
    ] = None

    @property
    def given(self) -> dict[str, Any]:
        """The options of single figures that were given, by name."""
        every = {key: value for key, value in vars(self).items() if value is not None}
        return {key: value for key, value in every.items() if key not in ("figure", "out")}


def main(options: Options, overrides: list[str]) -> int:
    """Draw a figure of the papers into a file: vector graphics with text as text, or PNG.

    Overrides choose data set and partition: dataset=mfnet dataset.root=/data/MFNet metric=ring9;
    stored statistics are of one partition, only heat maps can be cut anew
    """
    from analysis.figures.catalogue import FIGURES, make

    figure, out, given = options.figure, options.out, options.given
    if figure == "list":
        idle = [*(["out"] if out else []), *given, *overrides]
        if idle:
            raise InputError(f"'{idle[0]}' needs the name of a figure: figure=...")
        from rgbt.tracking.tables import TextTable
        from rgbt.tracking.terminal import print_rich, rich_table

        rows = tuple((name, spec.shows, spec.needs) for name, spec in FIGURES.items())
        print_rich(rich_table(TextTable("figures", ("figure", "shows", "made from"), rows)))
        return 0
    check_choice("figure", figure, FIGURES)
    if not out:
        raise InputError(
            f"'out' has no value; give the file to write, for example out={figure.split('/')[-1]}"
            ".pdf (or .svg, .png)."
        )
    from analysis.figures.style import out_path, save
    from rgbt.files.atomic import write_atomic

    path = out_path(out)
    drawn, numbers = make(figure, given, overrides)
    save(drawn, path)
    print(path)
    for suffix, text in numbers.items():
        beside = path.with_suffix(suffix)
        write_atomic(beside, text.encode())
        print(beside)
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
