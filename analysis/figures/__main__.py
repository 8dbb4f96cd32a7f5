"""Command that draws a figure of the papers: ``python -m analysis.figures figure=spatialseg/fig5``.

Without ``figure=`` it lists all figures and what each is made from.
"""

from __future__ import annotations

from rgbt.checks import InputError
from rgbt.config.command import plain_command

OF_FIGURES = (
    *("maps", "statistics", "methods", "runs", "runs_dir", "frames", "names", "pick", "rows"),
    *("layout", "split", "part", "regions", "absent", "estimator", "average", "patches", "seed"),
    *("band", "resamples", "level", "blocks", "size", "format", "suffix", "corruptions"),
)
"""Keys that single figures take (`analysis.figures.catalogue`)."""

OWN: dict[str, str | None] = {"figure": "list", "out": "", **dict.fromkeys(OF_FIGURES, "")}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Draw a figure of the papers into a file: vector graphics with text as text, or PNG.

    figure       name, e.g. spatialseg/fig5; "list" shows all of them with what each needs
    out          file to write; .pdf, .svg or .png (300 dots per inch)
    maps         folder (or its maps.npz) of python -m analysis.score
    statistics   folder (or its statistics.npz) of python -m analysis.spatial; or dataset=... to
                 measure it now
    methods      label:folder,label:folder; what analysis.score wrote (spatialseg/fig2, fig3), or
                 predicted label images (qualitative panels)
    runs         runs, groups or files of counts, with commas; label:run,label:run names them, and
                 entries with one label are seeds of one method
    runs_dir     folder of runs (runs)
    frames       pairs of frames of temporal/fig5: aligned or released (virtual views), or next
                 (consecutive frames), as python -m rgbt.consistency counts them
    split        split of the data set or of the runs (test; for statistics: train); a file that
                 holds another one is refused
    part         all, day or night
    names        images to show, with commas
    pick, rows   instead: rule (first, or largest_difference between the first and the last method)
                 and number (4) of images
    layout       rows or columns: one row, or one column, per image
    format       of predictions: auto, index or colour; suffix: NAME<suffix>.png
    regions      number of regions of each partition of spatialseg/fig2 (5)
    absent       how a class without pixels counts: released (0) or exclude; default: as counted
    estimator    of the noise: immerkaer, wavelet_mad or std; average: pooled or images
    patches      sizes of the patches of crm/fig5 (8,16,32,64); seed: of the masks (0)
    band         interval over: widest, images, seeds or both; with resamples (10000), level (0.95)
                 and blocks (auto, none, sequence or a number)
    size         of the picture of regions/heat (480x640), 16 to 4096 pixels a side
    corruptions  to show, with commas (robustness): noise:rgb,frozen; default: all that exist
    overrides of data set and partition: dataset=mfnet dataset.root=/data/MFNet metric=ring9;
    stored statistics are of one partition, heat maps alone can be cut anew
    """
    figure, out = arguments["figure"], arguments["out"]
    given = {key: arguments[key] for key in OF_FIGURES if arguments[key]}
    if figure == "list":
        idle = [*(["out"] if out else []), *given, *overrides]
        if idle:
            raise InputError(f"'{idle[0]}' needs the name of a figure: figure=...")
        return _list()
    return _draw(figure, out, given, overrides)


def _draw(figure: str, out: str, given: dict[str, str], overrides: list[str]) -> int:
    from analysis.figures.catalogue import FIGURES, make
    from rgbt.checks import check_choice

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


def _list() -> int:
    from analysis.figures.catalogue import FIGURES
    from rgbt.tracking.tables import Grid
    from rgbt.tracking.terminal import rich_table, show

    rows = tuple((name, entry.shows, entry.needs) for name, entry in FIGURES.items())
    show(rich_table(Grid("figures", ("figure", "shows", "made from"), rows)))
    return 0


if __name__ == "__main__":
    plain_command(OWN, main)()
