"""The page of published settings: the table of tests/published with its sources."""

from __future__ import annotations

from collections.abc import Iterator

import yaml

from reference_pages.markdown import code, page, table
from tests.published.recipes import Row, Section, Side, missing, rows_of, sections, unpublished


def recipes_page() -> str:
    """What is missing to each printed number; every setting by paper, release and experiment."""
    rows = [row for section in sections() for row in section.rows]
    sides = [name for row in rows for name in row.sides]
    return page(
        "# Published settings",
        "The settings of every experiment at `scale=paper`, with the place in the paper and in the "
        "released code. A test compares each with the composed configuration, and demands a source "
        f"or a reason for every key. The table has {len(rows)} rows with {sides.count('paper')} "
        f"values of papers, {sides.count('release')} of releases and {sides.count('ours')} that "
        "are ours, with the reason. [Paper and release](../explanation/paper-and-release.md) "
        "explains the differences.",
        "## What keeps you from the printed number",
        "You provide the data set and the file of initial weights. Printed values are single runs.",
        table(
            ["Experiment", "Data", "Initial weights", "What is missing or not known"],
            [_missing(name, text) for name, text in missing().items()],
        ),
        *_groups(),
        "## Settings without a published value",
        table(
            ["Settings", "Reason", "Keys"],
            [[each.name, each.reason, _names(each.keys)] for each in unpublished()],
        ),
    )


def _missing(name: str, text: str) -> list[str]:
    rows = rows_of(name)
    weights = rows["model.weights"].sides[rows["model.weights"].used[name]]
    start = code(weights.value) if weights.value else weights.place
    return [f"[`{name}`](experiments.md#{name})", rows["dataset._target_"].value(name), start, text]


def _groups() -> Iterator[str]:
    group = ""
    for section in sections():
        if section.group != group:
            group = section.group
            yield f"## {group}"
            yield "*Here* names the source that the experiment uses."
        yield f"### {section.title}"
        yield section.about
        yield f"Experiments: {_names(section.experiments)}."
        yield table(
            ["Setting", "Experiments", "Paper", "Release", "Here"],
            [
                [code(row.key), _experiments(row, section), *_sources(row), _here(row)]
                for row in section.rows
            ],
        )


def _experiments(row: Row, section: Section) -> str:
    """Those that a row holds for, where it does not hold for all of the section."""
    names = [name for name in section.experiments if name in row.used]
    return "all" if len(names) == len(section.experiments) else _names(names)


def _sources(row: Row) -> list[str]:
    return [_source(row.sides.get(name)) for name in ("paper", "release")]


def _source(side: Side | None) -> str:
    return f"{_shown(side.value)} ({side.place})" if side else ""


def _here(row: Row) -> str:
    """The source of the value: "paper", or "release: `cmx`; paper: the others"."""
    used = list(dict.fromkeys(row.used.values()))
    if len(used) == 1:
        same = all(side.value == row.sides[used[0]].value for side in row.sides.values())
        return _source(row.sides["ours"]) if used == ["ours"] else _agreeing(row, used[0], same)
    used.sort(key=lambda side: sum(name == side for name in row.used.values()))
    parts = [
        f"{_named(row, side)}: {_names([name for name in row.used if row.used[name] == side])}"
        for side in used[:-1]
    ]
    return "; ".join([*parts, f"{_named(row, used[-1])}: the others"])


def _agreeing(row: Row, side: str, same: bool) -> str:
    return "both" if same and {"paper", "release"} <= set(row.sides) else side


def _named(row: Row, side: str) -> str:
    return f"ours, {_source(row.sides['ours'])}" if side == "ours" else side


def _names(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join(code(name) for name in names)


def _shown(value: object) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6).removesuffix("...\n")
    return code(text.strip())
