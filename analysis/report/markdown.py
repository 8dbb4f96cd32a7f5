"""The results as Markdown pages: an index, a page of tables per paper, the networks."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from analysis.report import views
from analysis.report.claim_views import counted, paper_claims, placed
from analysis.report.data import ContrastEntry, ReportData, RunEntry
from analysis.report.markdown_claims import ClaimTexts, counts_table, forms_table, judged_table
from analysis.report.markdown_tables import TableText, markdown_table
from analysis.report.markdown_verdicts import verdicts_context
from analysis.report.networks import NetworkEntry
from analysis.report.page import STATIC, write_files
from analysis.report.results_file import Paper, load_results_file
from analysis.report.views import (
    DASH,
    Group,
    TableView,
    fixed,
    groups_of,
    interval_text,
    table_views,
    with_sign,
)
from rgbt.checks import InputError
from rgbt.metrics import names
from sweeps.table.request import DEFAULT_SCALE

WIDTH = 100
DIGEST = 12

MOST_IN_HEADING = 40
"""Characters of `rows=...` in the heading of a table."""

ABSOLUTE = re.compile(r"(?<![\w.:/)\]])/(?:[\w.+@%~-]+/)+([\w.+@%~-]*)")
"""A path from the root of a machine; addresses of pages and relative paths do not match."""

PAGE_NAME = re.compile(r"[\w-]+")
PAGES = ("index", "claims", "networks", "measurements")
"""Pages that are not about the tables of one folder."""

STUDY_PAGE = "studies"
STUDIES = Paper(title="Studies", reference="Tables of this project that no paper prints.")


def write_pages(data: ReportData, networks: Sequence[NetworkEntry], out: Path) -> list[Path]:
    """Write the pages; those that are there are replaced, other files of the folder stay.

    Args:
        data: of the store.
        networks: with their sizes.
        out: folder, made where it is missing.

    Raises:
        InputError: the folder cannot be made or written.
    """
    return write_files(page_texts(data, networks), out)


def page_texts(data: ReportData, networks: Sequence[NetworkEntry]) -> dict[str, str]:
    """Every page by the name of its file. Equal data give equal pages."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(STATIC),
        # Markdown: what looks like an element in a text of the store is made plain at the end.
        autoescape=False,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    filters = (views.fixed, views.plural, views.duration, wrapped, command_lines)
    environment.filters |= {each.__name__: each for each in filters}
    found = table_views(data)
    papers = _papers(found)
    views_by_name = sorted(found, key=lambda view: (view.entry.name, view.id))
    tables = {page: [v for v in views_by_name if _page_of(v) == page] for page in papers}
    shared = {"data": data, "papers": papers, "heading": heading, "letters": views.letters}

    def page(template: str, **more: object) -> str:
        text = environment.get_template(f"results_{template}.md.j2").render(**shared, **more)
        return without_paths(text)

    texts = {
        "index.md": page("index", **_index(data, tables)),
        "claims.md": page("claims", **verdicts_context(data, found, papers)),
    }
    for name, paper in papers.items():
        shown = [(view, text := TableText(view), text.markdown()) for view in tables[name]]
        claims = {view.id: ClaimTexts(placed(view)) for view in tables[name] if view.entry.claims}
        more = {"claims": claims, "counted": counted, "forms_table": forms_table}
        texts[f"{name}.md"] = page("paper", paper=paper, shown=shown, **more)
    texts["networks.md"] = page("networks", networks=networks, table=_network_table(networks))
    return texts


def wrapped(text: str, first: str = "", rest: str = "") -> str:
    """A paragraph in lines of `WIDTH` characters; `first` and `rest` stand before its lines."""
    return textwrap.fill(
        " ".join(text.split()),
        WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )


def command_lines(command: str) -> str:
    """A command in lines of less than `WIDTH` characters, each but the last ended by a backslash.

    A single word that is longer stays whole.
    """
    lines, current = [], ""
    for word in map(shlex.quote, shlex.split(command)):
        if current and len(current) + len(word) + 1 > WIDTH - 3:
            lines.append(f"{current} \\")
            current = " "
        current = f"{current} {word}" if current else word
    return "\n".join([*lines, current])


def without_paths(text: str) -> str:
    """Absolute paths cut to their last part: they hold names of users and machines."""
    return ABSOLUTE.sub(r".../\1", text)


def _papers(tables: Iterable[TableView]) -> dict[str, Paper]:
    """Pages of tables: the papers', then the studies and folders of the user's tables."""
    known = dict(load_results_file().papers)
    for view in tables:
        name = _page_of(view)
        if not PAGE_NAME.fullmatch(name) or name in PAGES:
            raise InputError(
                f"table '{view.entry.name}' cannot have a page {name}.md; rename its folder."
            )
        own = Paper(title=name, reference="Tables of the user.")
        known.setdefault(name, STUDIES if name == STUDY_PAGE else own)
    return known


def _page_of(view: TableView) -> str:
    """Name of the page of a table: the folder of its file; all studies of ours have one."""
    folder, slash, _ = view.entry.name.partition("/")
    return folder if slash else STUDY_PAGE


def _index(data: ReportData, tables: Mapping[str, Sequence[TableView]]) -> dict[str, object]:
    finished = [run for run in data.runs if run.status == "FINISHED"]
    groups = [group for group in groups_of(finished) if group.means]
    groups.sort(key=lambda group: (group.runs[0].scale, group.name))
    claims = paper_claims(view for views in tables.values() for view in views)
    return {
        "finished": finished,
        "on_paper": [run for run in finished if run.scale == "paper"],
        "small_scales": sorted({run.scale for run in finished} - {"paper"}),
        "on_gpu": [run for run in finished if run.hardware and not run.hardware.endswith("cores")],
        "on_real": [run for run in finished if not _is_embedded(run)],
        "page_links": ", ".join(f"[{name}]({name}.md)" for name in tables),
        "origin": _origin(data, finished),
        "contrast_table": _contrast_table(data.contrasts),
        "claim_counts": counts_table(claims) if claims else "",
        "claim_table": judged_table(claims),
        "commands": list(dict.fromkeys(each.command for each in data.contrasts)),
        "group_table": _group_table(groups),
        "table_lines": _table_lines(tables),
    }


def _is_embedded(run: RunEntry) -> bool:
    return ".synth" in run.config.get("dataset._target_", "")


def _origin(data: ReportData, finished: Sequence[RunEntry]) -> str:
    """Where the numbers come from, as a table."""
    versions: dict[str, set[str]] = {}
    for run in finished:
        for name, version in run.versions.items():
            versions.setdefault(name, set()).add(version)
    sets = {f"`{run.dataset[:DIGEST]}` ({run.images} {run.split} images)" for run in finished}
    rows = [
        ("date of these pages", data.made[:10]),
        ("finished runs", str(len(finished))),
        ("scale", _listed(run.scale for run in finished)),
        ("seeds", _listed(str(run.seed) for run in finished if run.seed is not None)),
        ("git commits", _listed(views.commit_text(run.commit) for run in finished)),
        ("data sets, by fingerprint", _listed(sets)),
        *((name, _listed(found)) for name, found in versions.items()),
        ("hardware", _listed(run.hardware for run in finished)),
    ]
    return markdown_table(["what", "value"], rows, (0, 1))


def _listed(texts: Iterable[str]) -> str:
    return ", ".join(sorted({text for text in texts if text})) or DASH


def _contrast_table(contrasts: Sequence[ContrastEntry]) -> str:
    header = [
        *("comparison", "metric", "reference", "method", "difference", "95 % interval", "p"),
        *("seeds", "expected", "verdict"),
    ]
    rows = []
    for each in contrasts:
        reference, method = (fixed(value) for value in each.values or (None, None))
        # Of one training each the interval is over images alone; the verdict says so.
        scale = f" ({each.scale} scale)" if each.scale else ""
        rows.append(
            [
                f"{each.question}{scale}: `{each.method}` against `{each.reference}`",
                each.metric,
                reference,
                method,
                with_sign(each.difference),
                interval_text(each.low, each.high),
                DASH if each.p is None else "< 0.001" if each.p < 0.001 else f"{each.p:.3f}",
                " and ".join(dict.fromkeys(map(str, each.seeds))) if each.values else DASH,
                f"{each.expected} ({each.source})",
                each.verdict,
            ]
        )
    return markdown_table(header, rows, (0, 1, 7, 8, 9))


def _group_table(groups: Sequence[Group]) -> str:
    shown = [
        [
            f"`{group.name}`",
            group.runs[0].scale,
            group.seeds,
            *(
                fixed(group.means.get(name))
                + (f" ± {fixed(sd)}" if views.is_number(sd := group.sds.get(name)) else "")
                for name in (names.MIOU, names.VAR)
            ),
        ]
        for group in groups
    ]
    header = ["method", "scale", "seeds", "mIoU", "Var"]
    return markdown_table(header, shown, (0, 1, 2))


def _table_lines(tables: Mapping[str, Sequence[TableView]]) -> str:
    """One line per table: how much of it has been run."""
    rows = []
    for page, of_page in tables.items():
        for view in of_page:
            entry = view.entry
            run = f"{view.rows_run} of {len(entry.rows)}" if view.rows_run else "not run"
            title = f"[{entry.number}]({page}.md#{anchor(view)})"
            claims = counted(entry.claims) if entry.claims else DASH
            rows.append([page, title, entry.scale or DASH, run, claims])
    header = ["paper", "table", "scale", "rows run", "claims"]
    return markdown_table(header, rows, (0, 1, 2, 3, 4))


def heading(view: TableView) -> str:
    """Heading of a table on its page."""
    entry = view.entry
    scale = "" if entry.scale in ("", DEFAULT_SCALE) else f"{entry.scale} scale"
    words = [_short(word) for word in shlex.split(entry.extra)]  # without the quotes of a shell
    which = ", ".join(filter(None, (scale, view.form, " ".join(words))))
    return f"{entry.number} ({which})" if which else entry.number


def _short(word: str) -> str:
    """An override as a heading shows it: without a long list of rows, which the table has."""
    is_long = word.startswith("rows=") and len(word) > MOST_IN_HEADING
    return "some rows" if is_long else f"`{word}`"


def anchor(view: TableView) -> str:
    """What a page calls the heading of a table, as Git hosts and MkDocs make it."""
    kept = re.sub(r"[^\w\s-]", "", heading(view).lower()).strip()
    return re.sub(r"\s", "-", kept)


def _network_table(networks: Sequence[NetworkEntry]) -> str:
    rows = []
    for entry in networks:
        for model, millions in zip(entry.network.models, entry.millions, strict=True):
            rows.append([entry.network.name, f"`model={model}`", f"{millions:.2f}"])
    header = ["network", "configuration", "million parameters"]
    return markdown_table(header, rows, (0, 1))
