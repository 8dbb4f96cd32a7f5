"""The page: one file with its data, style and scripts inside, which loads nothing."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from markupsafe import Markup

from analysis.report import charts, claim_views, views
from analysis.report.data import ReportData, RunEntry, StudyEntry, TrialEntry
from analysis.report.panels import class_records, panels_of, run_records
from rgbt.checks import InputError
from rgbt.files.atomic import write_atomic

STATIC = Path(__file__).with_name("static")

SECTIONS = (
    ("summary", "Summary"),
    ("claims", "Claims"),
    ("tables", "Tables"),
    ("runs", "Runs"),
    ("regions", "Regions"),
    ("searches", "Searches"),
    ("masks", "Masks"),
    ("differences", "Paper against release"),
)
"""Name behind #, which is also that of the template, and heading."""

POLICY = (
    "default-src 'none'; script-src {}; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)


def write_page(data: ReportData, out: Path) -> Path:
    """Write the page.

    Args:
        data: what it shows.
        out: folder, made where it is missing; a page that is there is replaced.

    Returns:
        ``out/index.html``.

    Raises:
        InputError: the folder cannot be made or written.
        ValueError: a picture that is not inside the data.
    """
    (page,) = write_files({"index.html": page_text(data)}, out)
    return page


def write_files(texts: Mapping[str, str], out: Path) -> list[Path]:
    """Write texts by the names of their files; existing files of these names are replaced.

    Args:
        texts: by file name.
        out: folder, made where it is missing.

    Raises:
        InputError: the folder cannot be made or written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            # Half of a surrogate pair in a text of the store is no UTF-8.
            write_atomic(out / name, text.encode(errors="xmlcharrefreplace"))
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"out={out}: {reason}; give a folder that can be written.") from error
    return [out / name for name in texts]


def page_text(data: ReportData) -> str:
    """The page as HTML.

    Its policy lets the browser run its own scripts by their hashes and load nothing: text from
    the store that got into the markup could neither run nor contact a server.

    Raises:
        ValueError: a picture that is not inside the data.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    for picture in data.masks:
        if not picture.address.startswith("data:image/"):
            raise ValueError(f"picture {picture.title}: {picture.address[:40]} is not in the data.")
    # Autoescape: what is `safe` in the templates is ours or JSON.
    environment = Environment(
        loader=FileSystemLoader(STATIC),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    numbers = (views.fixed, views.signed, views.with_sign, views.plural)
    times = (views.moment, views.duration, views.commit_text)
    environment.filters |= {each.__name__: each for each in (*numbers, *times)}
    functions = (views.is_number, views.letters, views.seed_span, views.interval_text)
    environment.globals |= {each.__name__: each for each in functions}
    environment.globals |= {"words": views.KINDS, "ranks": views.RANKS, "dash": views.DASH}
    environment.globals["claim_texts"] = claim_views
    scripts = [(STATIC / "early.js").read_text(), chart_library(), (STATIC / "page.js").read_text()]
    hashes = (hashlib.sha256(each.encode()).digest() for each in scripts)
    allowed = " ".join(f"'sha256-{base64.b64encode(each).decode()}'" for each in hashes)
    return environment.get_template("page.html.j2").render(
        **_context(data),
        data=data,
        sections=SECTIONS,
        policy=POLICY.format(allowed),
        scripts=scripts,
        style=(STATIC / "style.css").read_text(),
    )


def _context(data: ReportData) -> dict[str, Any]:
    """What the templates and the script read beside the data."""
    tables = views.table_views(data)
    run = [view for view in tables if view.is_run]
    groups, singles = views.groups_of(data.runs), views.groups_of(data.runs, single=True)
    measured = views.groups_of(run for run in data.runs if run.region_ious)
    mapped = [group for group in measured if group.kind]
    drawn = [group for group in (*groups, *singles) if group.regions]
    partitions = list(dict.fromkeys(group.runs[0].partition for group in drawn))
    alike = [group.id for group in groups if group.runs[0].partition in partitions[:1]]
    places = views.unique_names(f"study {study.name}" for study in data.studies)
    studies = list(zip(data.studies, places, strict=True))

    profile = charts.specification("profile")
    specs = {f"profile/{each}": {**profile, "title": each} for each in partitions}
    for view in run:
        made = charts.table_charts(view)
        specs |= {f"{view.id}/{index}": spec for index, spec in enumerate(made)}
    made_of = ((place, charts.study_chart(study, place)) for study, place in studies)
    specs |= {f"{place}/0": spec for place, spec in made_of if spec is not None}
    payload = {
        **run_records(singles),
        **panels_of(data, run, [*mapped, *groups], studies),
        "charts": specs,
        "chart_config": charts.specification("config"),
        "viridis": [views.Heat((0, 31)).colours(step)[0] for step in range(32)],
        "profiles": {
            group.id: {"partition": group.runs[0].partition, "rows": charts.profile_rows(group)}
            for group in drawn
        },
        "classes": {group.id: class_records(group) for group in mapped},
        "most_chosen": charts.MOST_CHOSEN,
        "silent": data.silent,
    }
    commits: dict[str, list[RunEntry]] = {}
    for each in data.runs:
        commits.setdefault(each.commit, []).append(each)
    return {
        "payload": embedded(payload),
        "run": run,
        "paper_claims": claim_views.paper_claims(tables),
        "waiting": [view for view in tables if not view.is_run],
        "specs": specs,
        "commits": list(commits.items()),
        "heat": views.Heat(chain.from_iterable(each.region_ious for each in data.runs)),
        "map_heat": views.Heat(each["mean"] for group in mapped for each in group.regions),
        "listed": [(each, False) for each in groups] + [(each, True) for each in singles],
        "chosen": alike[: charts.MOST_CHOSEN],
        "partitions": partitions,
        "mapped": mapped,
        "classes": _class_choices(mapped),
        "studies": [(study, place, _html(study.note)) for study, place in studies],
        "sorted_trials": _best_first,
        "map_size": (views.MAP_WIDTH, views.MAP_HEIGHT),
    }


def _class_choices(groups: Iterable[views.Group]) -> list[tuple[str, str]]:
    """Groups with scores by class, each followed by its runs: key in the script's data, name."""
    choices = []
    for group in groups:
        if all(run.class_region_ious for run in group.runs):
            single = len(group.runs) == 1
            name = group.runs[0].name if single else f"{group.name} (mean of {len(group.runs)})"
            choices.append((group.id, name))
            choices += [] if single else [(run.key, f"\u2003{run.name}") for run in group.runs]
    return choices


def _best_first(study: StudyEntry) -> list[TrialEntry]:
    """Trials by their objective; of several objectives the front first. Others last."""
    if len(study.objectives) > 1:
        return sorted(study.trials, key=lambda trial: not trial.on_front)
    sign = -1 if study.maximize[0] else 1
    known = sorted(filter(charts.is_complete, study.trials), key=lambda t: sign * t.values[0])
    return [*known, *(trial for trial in study.trials if not charts.is_complete(trial))]


def _html(markdown: str) -> Markup:
    """The report of a study as HTML: no markup of its own, nothing that is loaded or linked."""
    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = reader.disable(["image", "link", "autolink"]).parse(markdown)
    for token in tokens:
        if token.type.startswith("heading"):
            token.tag = "h4"
    return Markup(reader.renderer.render(tokens, reader.options, {}))


def embedded(plain: Any) -> str:
    """JSON that is safe inside a script element.

    Only ASCII, so that neither U+2028 nor half of a surrogate pair is in the file; no ``<``, so
    that no text can end the element. A number that is not finite becomes null, as JSON has none.
    """
    text = json.dumps(_finite(plain), allow_nan=False, separators=(",", ":"))
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(child) for key, child in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(child) for child in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@cache
def chart_library() -> str:
    """Vega-Lite and what draws its charts, as a script: defines ``vegaEmbed``."""
    import vl_convert

    # In a function, as its names would otherwise be those of the page.
    return f"(() => {{{vl_convert.javascript_bundle('window.vegaEmbed = vegaEmbed;')}}})();"
