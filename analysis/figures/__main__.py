"""Command that draws a figure of the papers: ``rgbt figures figure=spatialseg/fig5``.

Without ``figure=`` it lists all figures and their options.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, make_dataclass
from typing import Annotated, Any, get_args

from analysis.commands import text_table, tidy_csv
from analysis.figures import panels, scores, spatialseg  # noqa: F401 - they register their figures
from analysis.figures.inputs import FIGURES, Config
from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.options import Help, types_of
from rgbt.config.plain_command import PlainCommand

GROUPS = ("dataset", "metric", "consistency")


def _options() -> Iterator[tuple[str, Any, Any]]:
    """Yield name, type and default of `figure`, `out`, and the options of all figures."""
    yield "figure", Annotated[str, Help('name such as spatialseg/fig5; "list": all names')], "list"
    yield "out", Annotated[str, Help("output file: .pdf, .svg or .png (300 dots per inch)")], ""
    annotations: dict[str, Any] = {}
    for spec in FIGURES.values():
        annotations |= types_of(spec.options)
    for name, annotation in annotations.items():
        kind, *notes = get_args(annotation)
        yield name, Annotated[(kind | None, *notes)], None


FigureOptions: Any = make_dataclass("FigureOptions", _options(), frozen=True)


def main(options: Any, overrides: list[str]) -> int:
    """Draw a figure of the papers into a file: vector graphics with selectable text, or PNG.

    Overrides choose the data set and the partition: dataset=mfnet dataset.root=/data/MFNet
    metric=ring9. The numbers of the figure are written beside it, as .csv and .md.
    """
    import pandas as pd

    from analysis.figures.plots import out_path, save
    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import print_rich, rich_table

    given = {key: value for key, value in vars(options).items() if value is not None}
    name, out = given.pop("figure"), given.pop("out")
    if name == "list":
        rows = {}
        for key, listed_figure in sorted(FIGURES.items()):
            words = [*listed_figure.words, *listed_figure.groups]
            rows[key] = listed_figure.shows, " ".join(words)
        listed = pd.DataFrame.from_dict(rows, "index", columns=["shows", "options"])
        print_rich(rich_table(text_table("figures", listed.rename_axis("figure"))))
        return 0
    check_choice("figure", name, FIGURES)
    spec = FIGURES[name]
    known = [option.name for option in fields(spec.options)]
    idle = [key for key in given if key not in known]
    for word in overrides:
        group = word.lstrip("+~").partition("=")[0].split(".")[0]
        if group not in spec.groups:
            idle.append(group)
    if idle:
        near = nearest(idle[0], ["figure", "out", *known, *spec.groups])
        raise InputError(f"'{idle[0]}' has no effect on figure={name}; {near}.")
    path = out_path(out)
    config = Config(tuple(overrides), {"metric": spec.metric, "consistency": "views"})
    drawn, frame = spec(config, given)
    save(drawn, path)
    title = f"{name}: {spec.shows}"
    table = text_table(title, frame.set_index(frame.columns[0])).to_markdown()
    for suffix, text in ((".csv", tidy_csv(frame)), (".md", table)):
        write_atomic(path.with_suffix(suffix), text.encode())
    print(path)
    return 0


entry = PlainCommand(FigureOptions, main, heeds=GROUPS)

if __name__ == "__main__":
    entry()
