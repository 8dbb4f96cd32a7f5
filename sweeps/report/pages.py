"""Pages of results from finished runs: Markdown by one template, and one HTML file of the same."""

from __future__ import annotations

import base64
import hashlib
import re
import shlex
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError, one_line
from rgbt.files.yaml_files import read_yaml
from rgbt.metrics import names
from rgbt.metrics.named import value
from rgbt.runs.folder import GROUP
from rgbt.runs.provenance import commit_of, without_passwords
from rgbt.runs.result import RunResult
from rgbt.tables import ABSENT, TextTable, number
from sweeps.rendering.claims import (
    claim_grids,
    claim_lines,
    claims_frame,
    counted,
    counts_grid,
    statement,
)
from sweeps.rendering.publish import drawn_of, grid_of, grids_of
from sweeps.rendering.table import MARKDOWN
from sweeps.table.cells import OWN_COUNTS
from sweeps.table.efficiency import million_parameters
from sweeps.table.load_table import PUBLISHED
from sweeps.table.request import TAG
from sweeps.verdicts.judge import StoredRuns
from sweeps.verdicts.stored import TableResult, TableResults
from sweeps.worker.progress import duration

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

TEMPLATES = Path(__file__).with_name("templates")
STUDIES = "studies"
SCALES = ("smoke", "demo", "bench", "paper")
"""In the order in which a verdict counts more."""

ABSOLUTE = re.compile(r"(?<![\w.:/)\]])/(?:[\w.+@%~-]+/)+([\w.+@%~-]*)")
"""A path from the root of a machine; addresses of pages and relative paths do not match."""

MARKUP = re.compile(r"<(?!!-- |/?details\b|/?summary\b|https://)")
"""What is no markup of ours, such as an element in a text of a run."""

MARKED = re.compile(r"(<!-- results:(.+?) -->).*?(<!-- /results -->)", re.DOTALL)
"""Numbers in a page written by hand, between two comments."""

FOLDED = re.compile(r'^(<details markdown="1"><summary>[^<]*</summary>|</details>)$', re.MULTILINE)
PACKAGES = ("torch", "numpy", "hydra-core", "lightning-fabric", "opencv-python-headless")
ODD = (InputError, OSError, KeyError, ValueError, TypeError, AttributeError)
"""What a record that somebody has edited may raise."""


@dataclass(frozen=True)
class TableView:
    """A table as a section of a page; texts are Markdown."""

    result: TableResult
    claims_frame: pd.DataFrame
    figures: dict[str, Figure] = field(repr=False)

    @property
    def is_run(self) -> bool:
        """Whether it has a run."""
        return bool(self.result.runs)

    @property
    def name(self) -> str:
        """Of its page: the folder of its file; all studies of ours have one."""
        folder, slash, _ = self.result.request.name.partition("/")
        return folder if slash else STUDIES

    @property
    def how(self) -> str:
        """Scale, form and overrides of every row."""
        request = self.result.request
        form = "released form" if request.form == "released" else ""
        return ", ".join(filter(None, (f"scale={request.scale}", form, " ".join(request.extra))))

    @property
    def title(self) -> str:
        """Number, and how it was run."""
        table = self.result.request.table
        name = table.number if self.name != STUDIES else self.result.request.name
        return f"{name} ({self.how})" if self.is_run else name

    @property
    def caption(self) -> str:
        """What it shows, in a sentence."""
        return self.result.request.table.caption.rstrip(".") + "."

    @cached_property
    def grid(self) -> str:
        """Ours beside the printed values."""
        grid = grid_of(self.result, MARKDOWN)
        return TextTable("", grid.header, grid.rows, grid.notes).to_markdown().rstrip()

    @cached_property
    def grids(self) -> list[str]:
        """Effects of a design."""
        return [grid.to_markdown().rstrip() for grid in grids_of(self.result)]

    @cached_property
    def figure(self) -> str:
        """File name of the figure of a table with runs; "" without one."""
        drawn = drawn_of(self.result) if self.is_run else None
        request = self.result.request
        file = f"{request.name.replace('/', '-')}_{request.variant}.svg"
        if drawn is not None:
            self.figures[file] = drawn
        return "" if drawn is None else file

    @property
    def counted(self) -> str:
        """How many claims there are by verdict."""
        return counted(self.claims_frame)

    @cached_property
    def claims(self) -> str:
        """The claims of the paper about it."""
        return "\n".join(claim_lines(self.claims_frame)) if len(self.claims_frame) else ""

    @property
    def command(self) -> str:
        """What runs the missing rows."""
        request, seeds = self.result.request, self.result.scored.seeds
        count = str(len(seeds)) if seeds == tuple(range(len(seeds))) else ",".join(map(str, seeds))
        words = [f"table={request.name}", f"seeds={count if seeds else 3}"]
        words += [] if request.scale == "demo" else [f"scale={request.scale}"]
        words += [] if request.form == "paper" else [f"form={request.form}"]
        return shlex.join(["rgbt", "reproduce", *words, *request.extra])


@dataclass(frozen=True)
class PaperView:
    """A page of tables: those of a paper, of ours, or of the user."""

    name: str
    title: str
    reference: str
    views: Sequence[TableView]
    claims: pd.DataFrame

    @property
    def counted(self) -> str:
        """How many claims there are by verdict."""
        return counted(self.claims)

    @property
    def judged(self) -> list[str]:
        """Claims with a verdict."""
        frame = self.claims[self.claims["verdict"] != "not run"]
        return [grid.to_markdown().rstrip() for grid in claim_grids(frame)]

    @property
    def not_run(self) -> str:
        """Claims without a verdict."""
        frame = self.claims[self.claims["verdict"] == "not run"]
        return "\n".join(claim_lines(frame))


class Report:
    """Everything that the pages show, computed once from finished runs.

    Args:
        source: the tables.
        runs: the finished runs.
        studies: name of a study -> its report in Markdown.
        track: shows the progress of going over something.
    """

    def __init__(
        self,
        source: TableResults,
        runs: Sequence[RunResult],
        studies: Mapping[str, str],
        track: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    ) -> None:
        import pandas as pd

        self.figures: dict[str, Figure] = {}
        self.texts = read_yaml(TEMPLATES / "pages.yaml")
        self.source, self._runs, self.studies = source, runs, studies.items()
        self.views: list[TableView] = []
        for result in track(source):
            view = TableView(result, claims_frame(()), self.figures)
            frame = claims_frame(result.claims, view.how.partition(", ")[2])
            self.views.append(TableView(result, frame, self.figures))
        frames = [view.claims_frame for view in self.views if len(view.claims_frame)]
        every = pd.concat(frames, ignore_index=True) if frames else claims_frame(())
        ranks = every["scale"].map({scale: place for place, scale in enumerate(SCALES)}).fillna(-1)
        order = every.assign(rank=ranks, run=every["verdict"] != "not run")
        keys = ["run", "rank", "seeds"] if frames else ["rank"]
        best = order.sort_values(keys, ascending=False, kind="stable").drop_duplicates(
            ["table", "claim"] if frames else ["table"]
        )
        self.claims = best.sort_index().drop(columns=["rank", "run"])
        self._all = every
        self._stored = StoredRuns()
        self.remarks = source.remarks
        self.runs_grid, self.origin_grid, self.bases = self._of_runs()

    @property
    def papers(self) -> list[PaperView]:
        """The papers, our studies, and folders of the user's tables, in this order."""
        known = {
            name: (each["title"], each["reference"]) for name, each in self.texts["papers"].items()
        }
        known[STUDIES] = ("Studies", "Tables of this project that no paper prints.")
        for view in self.views:
            known.setdefault(view.name, (view.name, "Tables of the user."))
        of_view = self._all["table"].map(lambda name: name.rpartition("/")[0] or STUDIES)
        return [
            PaperView(
                *(name, title, reference),
                [view for view in self.views if view.name == name],
                self._all[of_view == name],
            )
            for name, (title, reference) in known.items()
        ]

    def _of_runs(self) -> tuple[str, str, list[str]]:
        """Runs by method, where they come from, and what they are about."""
        groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
        origin: dict[str, set[str]] = {}
        for run in self._runs:
            try:
                row = self._row(run)
                first = next(iter(run.provenance), {})
                packages = first.get("packages") or {}
                cpu = f"{first.get('cpu')}, {first.get('cpu_usable')} cores"
                facts = {
                    "git commits": commit_of(first),
                    "Python": first.get("python"),
                    **{name: packages.get(name) for name in PACKAGES},
                    "hardware": ", ".join(first.get("gpus") or []) or (first.get("cpu") and cpu),
                }
                for name, fact in facts.items():
                    origin.setdefault(name, set()).update(filter(None, [fact]))
                groups.setdefault(row.pop("key"), []).append(row)
            except ODD as error:
                self.remarks.append(f"Run {run.key} is left out: {one_line(error)}.")
        metrics = list(
            dict.fromkeys(name for each in groups.values() for name in each[0]["scores"])
        )
        rows = []
        for (group, images, scale, _), each in sorted(groups.items()):
            cells = []
            for metric in metrics:
                values = [row["scores"][metric] for row in each if metric in row["scores"]]
                spread = f" ± {number(statistics.stdev(values))}" if len(values) > 1 else ""
                cells.append(f"{number(statistics.fmean(values))}{spread}" if values else ABSENT)
            times = [row["seconds"] for row in each if row["seconds"] is not None]
            time = duration(statistics.median(times)) if times else ABSENT
            seeds = ", ".join(sorted((row["seed"] for row in each), key=lambda seed: seed.zfill(9)))
            tables = "; ".join(dict.fromkeys(name for row in each for name in row["tables"]))
            rows.append((group, images, scale, seeds, *cells, time, tables))
        header = ("method", "images", "scale", "seeds", *metrics, "time", "rows of")
        facts = [(name, ", ".join(sorted(each)) or ABSENT) for name, each in origin.items()]
        counts: dict[str, int] = {}
        for (_, images, scale, _), each in sorted(groups.items()):
            name = f"{images} images, scale={scale}"
            counts[name] = counts.get(name, 0) + len(each)
        grids = (TextTable("", header, tuple(rows)), TextTable("", ("what", "value"), tuple(facts)))
        texts = [grid.to_markdown().rstrip() if grid.rows else "" for grid in grids]
        return texts[0], texts[1], [f"{count} on {name}" for name, count in counts.items()]

    def _row(self, run: RunResult) -> dict[str, Any]:
        tags, basis = run.tags, self._stored.basis([run])
        counts = self._stored.counts(run, OWN_COUNTS)
        regions = [names.region(place + 1) for place in range(counts.counts.shape[1])]
        metrics = (names.MIOU, names.VAR, *regions)
        return {
            "key": (tags.get(GROUP, run.key), basis.images, basis.scale, counts.dataset),
            "seed": tags.get("rgbt.seed", ABSENT),
            "scores": {name: value(name, counts, counts.absent) for name in metrics},
            "seconds": run.result.get("seconds_of_last_process"),
            "tables": [tag.removeprefix(TAG) for tag in sorted(tags) if tag.startswith(TAG)],
        }

    @property
    def limits(self) -> list[str]:
        """What the verdicts do not say, one sentence or two each."""
        judged = self._all[self._all["verdict"] != "not run"]
        said = []
        if "paper" not in set(judged.get("scale", ())):
            said.append(
                "**Networks:** no verdict is at paper scale. Small networks on small images say "
                "something about a method at that scale, and neither confirm nor refute a number."
            )
        for column, word, text in (
            ("images", "synthetic", "is on synthetic scenes: what these lack, it cannot show"),
            ("start", "one start for all seeds", "is from one start, see the warning beside it"),
            ("covers", "images", "is of one training: other trainings are not covered"),
        ):
            if count := int((judged.get(column, judged["verdict"]) == word).sum()):
                said.append(f"**{column.capitalize()}:** the verdict of {count} claims {text}.")
        chance = f"**Chance:** of {len(judged)} claims without any effect, up to"
        said.append(f"{chance} {0.025 * len(judged):.1f} would be called holding.")
        return said

    def page(self, name: str) -> str:
        """A page as Markdown: "index", "claims", "networks", "all" or the name of a paper."""
        from jinja2 import Environment, FileSystemLoader, StrictUndefined

        environment = Environment(
            loader=FileSystemLoader(TEMPLATES),
            autoescape=False,  # Markdown; `MARKUP` makes plain what looks like an element
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        papers = self.papers
        own = [view for view in self.views if view.is_run or view.name not in self.texts["papers"]]
        data = {
            "num_runs": len(self._runs),
            "bases": self.bases,
            "at_paper_scale": any("scale=paper" in each for each in self.bases),
            "runs": self.runs_grid,
            "origin": self.origin_grid,
            "remarks": self.remarks,
            "counts": counts_grid(self.claims).to_markdown().rstrip(),
            "papers": papers,
            "limits": self.limits,
            "own": [view for view in own if view.is_run or view.name != STUDIES],
            "papers_tables": [view for view in self.views if view not in own],
            "studies": self.studies,
            "any_verdict": bool((self.claims["verdict"] != "not run").any()),
            **(_networks(self.texts["networks"]) if name == "networks" else {}),
        }
        paper = next((each for each in papers if each.name == name), None)
        text = environment.get_template("pages.md.j2").render(data=data, page=name, paper=paper)
        text = re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"
        return MARKUP.sub("&lt;", ABSOLUTE.sub(r".../\1", without_passwords(text)))

    def pages(self) -> dict[str, str]:
        """Every page of ``docs/results`` by the name of its file; those of a user's tables too."""
        every = ["index", "claims", "networks", *(each.name for each in self.papers)]
        return {f"{name}.md": self.page(name) for name in every}

    def html(self) -> str:
        """All of it as one file, which loads nothing and runs only its own script."""
        from jinja2 import Environment, FileSystemLoader
        from markdown_it import MarkdownIt

        text = re.sub(r"<!--.*?-->\n", "", self.page("all"))
        reader = MarkdownIt("commonmark", {"html": False}).enable("table")
        parts = enumerate(FOLDED.split(text))
        body = "".join(part if place % 2 else reader.render(part) for place, part in parts)
        body = body.replace("<table>", '<div class="scroll"><table>')
        body = body.replace("</table>", "</table></div>")
        for name, content in self.images().items():
            address = f"data:image/svg+xml;base64,{base64.b64encode(content).decode()}"
            body = body.replace(f'src="{name}"', f'src="{address}"')
        script = (TEMPLATES / "sort.js").read_text()
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        shell = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True)
        page = shell.get_template("page.html.j2")
        return page.render(body=body, script=script, hash=f"sha256-{digest}")

    def images(self) -> dict[str, bytes]:
        """The figures of the pages that were made, as SVG by the names of their files."""
        import tempfile

        from sweeps.rendering.figure import write_figure

        with tempfile.TemporaryDirectory() as folder:
            return {
                name: write_figure(figure, Path(folder, name)).read_bytes()
                for name, figure in sorted(self.figures.items())
            }

    def filled(self, text: str) -> str:
        """A page written by hand with its marked numbers made again.

        Marks: ``claim TABLE NAME`` is a claim with its verdict, ``count`` the number of claims of
        the papers, ``effects TABLE OUTCOME`` the effects of a design on an outcome.

        Raises:
            InputError: a mark that names nothing.
        """
        return MARKED.sub(lambda mark: f"{mark[1]}{self._block(mark[2])}{mark[3]}", text)

    def _block(self, mark: str) -> str:
        kind, *words = mark.split()
        if kind == "count":
            return str(int(self.claims["table"].str.contains("/").sum()))
        views = [view for view in self.views if view.result.request.name == words[0]]
        if kind == "claim":
            found = self.claims[(self.claims["table"] == words[0])]
            found = found[found["claim"] == words[1]]
            if len(found):
                row = found.iloc[0]
                command = f" (`rgbt reproduce table={words[0]} scale=bench seeds=4`)"
                return statement(row) + command * (row["verdict"] == "not run")
        if kind == "effects" and views and views[0].result.effects is not None:
            grids = [grid for grid in views[0].grids if f"Effects on {words[1]}," in grid]
            rows = "rows=tested scale=bench seeds=3"
            empty = f"No run yet: `rgbt reproduce table={words[0]} {rows}`."
            picture = f"![{views[0].title}]({views[0].figure})" if views[0].figure else ""
            texts = [picture, *grids] if picture else grids
            return "\n\n" + "\n\n".join(texts or [empty]) + "\n\n"
        raise InputError(f"<!-- results:{mark} --> names no claim, design or number.")


def _networks(networks: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The grids of the page of networks; each is built without memory to count its parameters."""
    sizes, weights, tests = [], [], []
    for each in networks:
        for model in each["models"]:
            words = [*each.get("overrides", ()), *f"model={model}".split()]
            sizes.append((each["name"], f"`model={model}`", f"{million_parameters(words):.2f}"))
        weights += [(each["name"], file, f"<{address}>") for file, address in each["weights"]]
        tests.append((each["name"], ", ".join(f"`{test}`" for test in each["tests"])))
    headers = (
        ("network", "configuration", "million parameters"),
        ("network", "file", "published at"),
    )
    grids = {
        "networks": TextTable("", headers[0], tuple(sizes)),
        "weights": TextTable("", headers[1], tuple(weights)),
        "tests": TextTable("", ("network", "test"), tuple(tests)),
    }
    return {name: grid.to_markdown().rstrip() for name, grid in grids.items()}


PAPERS = tuple(sorted(path.name for path in PUBLISHED.iterdir()))
