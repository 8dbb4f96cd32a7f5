"""Pages of results from finished runs: Markdown by one template, and one HTML file of the same."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from analysis.results import finished_runs
from rgbt.checks import InputError
from rgbt.config.options import readable_paths
from rgbt.files.yaml_files import read_yaml
from rgbt.tables import number
from sweeps.judge.agreement import contrasts_frame, pairs_of, ranks_of, signs_of
from sweeps.judge.judged_claim import NOT_RUN
from sweeps.judge.stored_tables import judged_tables, known_tables
from sweeps.plan.planner import Planner
from sweeps.score.reader import REAL, SYNTHETIC, RunReader
from sweeps.show.agreement import (
    agreement_lines,
    pairs_grid,
    ranks_grid,
    sides_figure,
    sides_grid,
    signs_grid,
    signs_in_words,
)
from sweeps.show.claims import chance_of, counts_grid, statement
from sweeps.show.html import TEMPLATES, html_page
from sweeps.show.own import own_section
from sweeps.show.sections import (
    STUDIES,
    TableSection,
    claims_of,
    markdown,
    networks_section,
    number_of,
    paper_section,
    public,
    runs_section,
)

if TYPE_CHECKING:
    import pandas as pd

# Scales in the order in which their verdicts count more.
SCALES = ("smoke", "demo", "bench", "real", "paper")

# Beginning of markup that is not ours, such as an element in a text of a run.
MARKUP = re.compile(r"<(?!!-- |/?details\b|/?summary\b|https://)")

# Numbers in a page written by hand, between two comments.
MARKED = re.compile(r"(<!-- results:(.+?) -->).*?(<!-- /results -->)", re.DOTALL)


class Report:
    """Everything that the pages show, computed once from the runs of a folder and an archive.

    Args:
        resamples: of the images, for the intervals.
        counted: with sizes of networks, which needs torch.

    Attributes:
        runs: all finished runs; `reader` has those that a table may have.
        tables: a section for every table, in every way that it was run.
        every: their claims; `claims` has each claim once.
        remarks: what cannot be read or composed, one sentence each.
    """

    def __init__(self, runs_dir: Path, archive: Path, resamples: int, *, counted: bool) -> None:
        self.runs_dir, self.resamples = runs_dir, resamples
        self.texts = read_yaml(TEMPLATES / "pages.yaml")
        self.runs = finished_runs(runs_dir, archive)
        self.reader = RunReader(self.runs)
        self.remarks: list[str] = []
        known = known_tables(self.remarks)
        self.remarks += self.reader.remarks
        planner = Planner(readable_paths([f"runs_dir={runs_dir}"]))
        judged = judged_tables(
            self.reader, planner, known, self.remarks, resamples=resamples, counted=counted
        )
        self.tables = [TableSection(table) for table in judged]
        self.every = claims_of(self.tables)
        were_run = [section.judged for section in self.tables if section.is_run]
        self.contrasts, self.ranks = contrasts_frame(were_run), ranks_of(were_run)
        self.agreement = agreement_lines(signs_of(self.contrasts), self.ranks)
        self.claims = self._decisive_claims()
        self.data = runs_section(self.runs, self.reader, self.remarks)
        self.papers = self._papers()
        self.studies: dict[str, str] = {}
        for path in sorted(runs_dir.glob("studies/*/study.md")):
            self.studies[path.parent.name] = path.read_text(errors="replace")

    def _decisive_claims(self) -> pd.DataFrame:
        """Every claim once: judged, at the largest scale, by declared seeds, or by the most."""
        ranks = self.every["scale"].map({scale: rank for rank, scale in enumerate(SCALES)})
        is_sure = self.every["basis"] == "confirmation"
        is_judged = self.every["verdict"] != NOT_RUN
        ranked = self.every.assign(rank=ranks.fillna(-1), sure=is_sure, judged=is_judged)
        order = ranked.sort_values(["judged", "rank", "sure", "seeds"], kind="stable")
        return order.drop_duplicates(["table", "claim"], keep="last").sort_index()

    def _papers(self) -> list[dict[str, Any]]:
        """The pages of tables: those of the papers, of our studies, then of the user."""
        known = {}
        for name, paper in self.texts["papers"].items():
            known[name] = (paper["title"], paper["reference"])
        known[STUDIES] = ("Studies", "Tables of this project that no paper prints.")
        for table in self.tables:
            known.setdefault(table.page, (table.page, "Tables of the user."))
        return [
            paper_section(name, title, reference, self.tables, self.contrasts, self.ranks)
            for name, (title, reference) in known.items()
        ]

    @property
    def waiting(self) -> list[TableSection]:
        """The tables that could be run, and have no run yet."""
        return [table for table in self.tables if not (table.is_run or table.is_printed)]

    @property
    def limits(self) -> list[str]:
        """What the verdicts do not say, one sentence or two each."""
        judged = self.claims[self.claims["verdict"] != NOT_RUN]
        sentences = []
        if "paper" not in set(judged["scale"]):
            sentences.append(
                "**Networks:** no verdict is at paper scale. Small networks on small images say "
                "something about a method at that scale, and neither confirm nor refute a number."
            )
        for column, word, text in (
            ("images", SYNTHETIC, "is on synthetic scenes: what these lack, it cannot show"),
            (
                "basis",
                "exploration",
                "is by seeds whose number may depend on results, not confirmed",
            ),
            ("start", "one start for all seeds", "is from one start, see the warning beside it"),
            ("covers", "images", "is of one training: other trainings are not covered"),
        ):
            count = int((judged[column] == word).sum())
            if count:
                name = column.capitalize()
                sentences.append(f"**{name}:** the verdict of {count} claims {text}.")
        chance = chance_of(self.claims)
        return [*sentences, f"**Chance:** {chance}"] if chance else sentences

    def page(self, name: str) -> str:
        """Return a page as Markdown: "index", "claims", "agreement", ..., or name of a paper."""
        environment = Environment(
            loader=FileSystemLoader(TEMPLATES),
            autoescape=False,  # Markdown; `MARKUP` makes plain what looks like an element
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        data = {
            **self.data,
            "num_runs": len(self.runs),
            "at_paper_scale": any("scale=paper" in grid for grid in self.data["runs"]),
            "remarks": self.remarks,
            "counts": markdown(counts_grid(self.claims)),
            "papers": self.papers,
            "limits": self.limits,
            "agreement": self.agreement,
            "signs": markdown(signs_grid(self.contrasts)),
            "ranks": markdown(ranks_grid(self.ranks)),
            "were_run": [table for table in self.tables if table.is_run],
            "waiting": self.waiting,
            "studies": self.studies.items(),
            "any_verdict": bool((self.claims["verdict"] != NOT_RUN).any()),
        }
        if name == "real-images":  # draws tables anew, which no other page needs
            sides = sides_grid(self.contrasts, REAL)
            data["sides"] = markdown(sides) if sides.rows else ""
            data["pairs"] = markdown(pairs_grid(pairs_of(self.contrasts)))
        if name == "networks":
            data |= networks_section(self.texts["networks"])
        papers = {paper["name"]: paper for paper in self.papers}
        template = environment.get_template("pages.md.j2")
        text = template.render(data=data, page=name, paper=papers.get(name))
        text = re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"
        return MARKUP.sub("&lt;", public(text))

    def pages(self) -> dict[str, str]:
        """Return every page of ``docs/results`` by its file; those of a user's tables too."""
        names = [
            "index",
            "claims",
            "agreement",
            "real-images",
            "networks",
            *(paper["name"] for paper in self.papers),
        ]
        return {f"{name}.md": self.page(name) for name in names}

    def html(self) -> str:
        """Return all of it as one file, which loads nothing and runs only its own script."""
        own = own_section(self.runs, self.reader, self.runs_dir, self.resamples, self.remarks)
        left = int((self.claims["verdict"] == NOT_RUN).sum()), len(self.waiting)
        own["left"] = f"{number_of(left[0], 'claim')} and {number_of(left[1], 'table')}"
        return html_page(own, self.page("all"), self.page("not-run"), self.images)

    @cached_property  # a second drawing has another layout
    def images(self) -> dict[str, bytes]:
        """The figures of the pages that were made, as SVG by the names of their files."""
        from analysis.figures.plots import content_of

        drawn = {table.figure: table.drawn for table in self.tables}
        drawn |= {paper["picture"]: paper["forest"] for paper in self.papers}
        drawn["real-images_contrasts.svg"] = sides_figure(self.contrasts, REAL)
        return {name: content_of(found, "svg") for name, found in drawn.items() if found}

    def filled(self, text: str) -> str:
        """Return a page written by hand with its marked numbers made again.

        Marks: ``claim TABLE NAME`` is a claim with its verdict, ``count`` the number of claims of
        the papers and ``count runs`` that of runs, ``signs`` how far they have the printed signs,
        ``cell TABLE COLUMN ROW`` a mean over seeds with
        its standard deviation, ``effects TABLE OUTCOME`` the effects of a design on an outcome.
        InputError: a mark that names nothing.
        """
        return MARKED.sub(lambda mark: f"{mark[1]}{self._number(mark[2])}{mark[3]}", text)

    def _number(self, mark: str) -> str:
        """What a mark names."""
        if mark == "signs":
            return "; ".join(signs_in_words(signs_of(self.contrasts)))
        if mark == "count runs":
            return str(len(self.runs))
        if mark == "count":
            return str(int(self.claims["table"].str.contains("/").sum()))
        kind, _, rest = mark.partition(" ")
        name, _, rest = rest.partition(" ")
        text = None
        tables = [table for table in self.tables if table.judged.request.name == name]
        if kind == "claim":
            text = self._claim(name, rest)
        elif kind == "cell" and tables:
            text = _cell(tables[0], rest)
        elif kind == "effects" and tables:
            text = _effects(tables[0], rest)
        if text is None:
            raise InputError(f"<!-- results:{mark} --> names no claim, design or number.")
        return text

    def _claim(self, table: str, name: str) -> str | None:
        """A claim with its verdict, or with the command that runs it."""
        found = self.claims[(self.claims["table"] == table) & (self.claims["claim"] == name)]
        if found.empty:
            return None
        text = statement(found.iloc[0])
        if found.iloc[0]["verdict"] == NOT_RUN:
            text += f" (`rgbt reproduce table={table} scale=bench seeds=confirm`)"
        return text


def _cell(table: TableSection, text: str) -> str | None:
    """A mean over seeds with its standard deviation; `text` is the column, then the row."""
    column, _, row = text.partition(" ")
    cell = table.judged.scored.cells.get((row, column))
    return None if cell is None else f"{number(cell.mean)} ± {number(cell.sd)}"


def _effects(table: TableSection, outcome: str) -> str | None:
    """The figure and the effects of a design on an outcome, or the command that runs it."""
    request = table.judged.request
    if request.table.design is None:
        return None
    texts = [grid for grid in table.grids if f"Effects on {outcome}," in grid]
    if table.figure:
        texts.insert(0, f"![{table.title}]({table.figure})")
    if not texts:
        words = "rows=tested scale=bench seeds=3"
        texts.append(f"No run yet: `rgbt reproduce table={request.name} {words}`.")
    return "\n\n" + "\n\n".join(texts) + "\n\n"
