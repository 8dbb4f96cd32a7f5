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
    """The figure, and the options of single figures (`analysis.figures.catalogue`)."""

    figure: Annotated[
        str, Help('name of the figure, such as spatialseg/fig5; "list": all names and their inputs')
    ] = "list"
    out: Annotated[str, Help("output file: .pdf, .svg or .png (300 dots per inch)")] = ""
    maps: Annotated[str | None, Help("output of rgbt score: folder or maps.npz")] = None
    statistics: Annotated[
        str | None,
        Help(
            "output of rgbt spatial: folder or statistics.npz; or dataset=... to measure the data "
            "set now"
        ),
    ] = None
    methods: Annotated[
        str | None,
        Help(
            "methods, label:folder,label:folder: output of rgbt score (spatialseg/fig2, fig3), or "
            "predicted label images (qualitative panels, pairs of frames)"
        ),
    ] = None
    without_rgb: Annotated[
        str | None,
        Help(
            "predictions of these methods without RGB (rgbt predict corruption=removed:rgb), "
            "label:folder,label:folder, for crm/fig2"
        ),
    ] = None
    without_thermal: Annotated[
        str | None, Help("the same without thermal (rgbt predict corruption=removed:thermal)")
    ] = None
    runs: Annotated[
        str | None,
        Help(
            "runs, groups or files of counts, separated by commas; label:run,label:run sets their "
            "labels; entries with the same label are seeds of one method"
        ),
    ] = None
    runs_dir: Annotated[str | None, Help("folder of runs (default: runs)")] = None
    pairs: Annotated[
        str | None,
        Help(
            "pairs of frames: folder that rgbt consistency export=... wrote (temporal/fig1, fig6)"
        ),
    ] = None
    view_set: Annotated[
        Count | None, Help("set of virtual views that is shown of these pairs, from 1 (default: 1)")
    ] = None
    frames: Annotated[
        Literal["aligned", "released", "next"] | None,
        Help(
            "pairs of frames of temporal/fig5, counted by rgbt consistency: aligned or released "
            "(virtual views), or next (consecutive frames)"
        ),
    ] = None
    split: Annotated[
        str | None,
        Help(
            "split of the data set or of the runs (default: test; for statistics: train); a file "
            "of another split is refused"
        ),
    ] = None
    part: Annotated[Literal["all", "day", "night"] | None, Help("images: all, day or night")] = None
    names: Annotated[str | None, Help("names of the images to show, separated by commas")] = None
    pick: Annotated[
        Literal["first", "largest_difference"] | None,
        Help(
            "rule that selects the images instead of names=: first, or largest_difference between "
            "the first and the last method"
        ),
    ] = None
    rows: Annotated[Count | None, Help("number of images (default: 4)")] = None
    layout: Annotated[
        Literal["rows", "columns"] | None, Help("one row or one column per image: rows or columns")
    ] = None
    format: Annotated[
        Literal["auto", "index", "colour"] | None,
        Help("format of predictions: auto, index or colour"),
    ] = None
    palette: Annotated[str | None, Help("palette of coloured predictions, as in `rgbt score`")] = (
        None
    )
    prefix: Annotated[str | None, Help("beginning of the file names of predictions")] = None
    suffix: Annotated[
        str | None, Help("suffix of the file names of predictions, NAME<suffix>.png")
    ] = None
    regions: Annotated[
        Count | None, Help("number of regions of each partition of spatialseg/fig2 (default: 5)")
    ] = None
    absent: Annotated[
        Literal["released", "exclude"] | None,
        Help(
            "class without pixels: released: it scores 0; exclude: it is in no mean; default: "
            "convention of the data set"
        ),
    ] = None
    estimator: Annotated[
        Literal["immerkaer", "wavelet_mad", "std"] | None,
        Help("estimator of the noise: immerkaer, wavelet_mad or std"),
    ] = None
    average: Annotated[
        Literal["pooled", "images"] | None,
        Help("signal-to-noise ratio over images: pooled or images"),
    ] = None
    patches: Annotated[
        tuple[Count, ...] | None,
        Help("sides of the patches of crm/fig5 in pixels (default: 8,16,32,64)"),
    ] = None
    seed: Annotated[
        Annotated[int, Interval(ge=0, le=MOST)] | None, Help("seed of the masks (default: 0)")
    ] = None
    band: Annotated[
        Literal["widest", "images", "seeds", "both"] | None,
        Help("interval over images, seeds or both; widest: both if possible"),
    ] = None
    resamples: Annotated[
        Count | None, Help("number of resamples for that interval (default: 10000)")
    ] = None
    level: Annotated[float | None, Help("confidence level of that interval (default: 0.95)")] = None
    blocks: Annotated[
        Blocks | None,
        Help("images resampled together: auto, none, sequence, or a number of neighbouring frames"),
    ] = None
    size: Annotated[
        str | None,
        Help("size of regions/heat, 16 to 4096 pixels per side (default: 480x640)"),
    ] = None
    corruptions: Annotated[
        str | None,
        Help(
            "corruptions to show (robustness), separated by commas: noise:rgb,frozen; default: all "
            "that were measured"
        ),
    ] = None

    @property
    def given(self) -> dict[str, Any]:
        """The options of single figures that were given, by name."""
        every = {key: value for key, value in vars(self).items() if value is not None}
        return {key: value for key, value in every.items() if key not in ("figure", "out")}


def main(options: Options, overrides: list[str]) -> int:
    """Draw a figure of the papers into a file: vector graphics with selectable text, or PNG.

    Overrides choose the data set and the partition: dataset=mfnet dataset.root=/data/MFNet
    metric=ring9. Stored statistics have one partition; only heat maps can use another one
    """
    from analysis.figures.catalogue import FIGURES, make

    figure, out, given = options.figure, options.out, options.given
    if figure == "list":
        idle = [*(["out"] if out else []), *given, *overrides]
        if idle:
            raise InputError(f"'{idle[0]}' needs the name of a figure: figure=...")
        from rgbt.tables import TextTable
        from rgbt.terminal import print_rich, rich_table

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
