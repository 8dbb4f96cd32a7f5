"""Pages of results from finished runs: Markdown by one template, and one HTML file of the same."""

from __future__ import annotations

import base64
import hashlib
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
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
from sweeps.judge.stored_tables import TableResult, TableResults
from sweeps.plan.request import TAG
from sweeps.run.progress import duration
from sweeps.score.efficiency import million_parameters
from sweeps.show.claims import (
    claim_grids,
    claim_lines,
    claims_frame,
    counted,
    counts_grid,
    statement,
)
from sweeps.show.publish import drawn_of, grid_of, grids_of
from sweeps.show.table import MARKDOWN

if TYPE_CHECKING:
    import pandas as pd

TEMPLATES = Path(__file__).with_name("templates")
STUDIES = "studies"
# Scales in the order in which their verdicts count more.
SCALES = ("smoke", "demo", "bench", "paper")

# A path from the root of a machine; addresses of pages and relative paths do not match.
ABSOLUTE = re.compile(r"(?<![\w.:/)\]])/(?:[\w.+@%~-]+/)+([\w.+@%~-]*)")

# Beginning of markup that is not ours, such as an element in a text of a run.
MARKUP = re.compile(r"<(?!!-- |/?details\b|/?summary\b|https://)")

# Numbers in a page written by hand, between two comments.
MARKED = re.compile(r"(<!-- results:(.+?) -->).*?(<!-- /results -->)", re.DOTALL)

FOLDED = re.compile(r'^(<details markdown="1"><summary>[^<]*</summary>|</details>)$', re.MULTILINE)
PACKAGES = ("torch", "numpy", "hydra-core", "lightning-fabric", "opencv-python-headless")
# Errors that a record may raise that somebody has edited.
ODD = (InputError, OSError, KeyError, ValueError, TypeError, AttributeError)


class TableView:
    """A table as a section of a page; texts are Markdown.

    Attributes:
        name: of its page: the folder of its file; all studies of ours have one.
        how: scale, form and overrides of every row.
        drawn: its figure, and `figure` the name of its file; None, and "", without one.
    """

    def __init__(self, result: TableResult) -> None:
        request, seeds = result.request, result.scored.seeds
        folder, slash, _ = request.name.partition("/")
        self.result, self.is_run = result, bool(result.runs)
        self.name = folder if slash else STUDIES
        form = "released form" if request.form == "released" else ""
        words = shlex.join(result.words)
        self.how = ", ".join(filter(None, (f"scale={request.scale}", form, words)))
        title = request.table.number if slash else request.name
        self.title = f"{title} ({self.how})" if self.is_run else title
        self.caption = request.table.caption.rstrip(".") + "."
        self.frame = claims_frame(result.claims, ", ".join(filter(None, (form, words))))
        self.counted = counted(self.frame)
        self.claims = "\n".join(claim_lines(self.frame))
        grids = [replace(grid_of(result, MARKDOWN), title=""), *grids_of(result)]
        self.grids = list(map(markdown, grids)) if self.is_run else []
        rows = {label for label, _ in result.runs}
        self.drawn = drawn_of(result) if len(rows) > 1 else None  # one row compares nothing
        variant = replace(request, extra=result.words).variant
        file = f"{request.name.replace('/', '-')}_{variant}.svg"
        self.figure = file if self.drawn is not None else ""
        count = str(len(seeds)) if seeds == tuple(range(len(seeds))) else ",".join(map(str, seeds))
        typed = [f"table={request.name}", f"seeds={count if seeds else 3}"]
        typed += [] if request.scale == "demo" else [f"scale={request.scale}"]
        typed += [] if request.form == "paper" else [f"form={request.form}"]
        self.command = shlex.join(["rgbt", "reproduce", *typed, *result.words])


class PaperView:
    """A page of tables: those of a paper, of ours, or of the user."""

    def __init__(self, name: str, title: str, reference: str, views: Sequence[TableView]) -> None:
        self.name, self.title, self.reference = name, title, reference
        self.views = [view for view in views if view.name == name]
        frame = claims_of(self.views)
        is_run = frame["verdict"] != "not run"
        self.counted = counted(frame)
        self.judged = list(map(markdown, claim_grids(frame[is_run])))
        tables = frame["table"].str.split("/").str[-1]
        lines = "- " + tables + ", `" + frame["claim"] + "`: " + frame["says"]
        self.not_run = "\n".join(lines[~is_run])


def markdown(grid: TextTable) -> str:
    """A grid in Markdown; "" for one without rows."""
    return grid.to_markdown().rstrip() if grid.rows else ""


def claims_of(views: Sequence[TableView]) -> pd.DataFrame:
    """The claims of all these tables, once for every way that they were run."""
    import pandas as pd

    frames = [view.frame for view in views if len(view.frame)]
    return pd.concat(frames, ignore_index=True) if frames else claims_frame(())


class Report:
    """Everything that the pages show, computed once from finished runs.

    `studies` maps the name of a study to its report in Markdown; `track` shows progress.
    """

    def __init__(
        self,
        source: TableResults,
        runs: Sequence[RunResult],
        studies: Mapping[str, str],
        track: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    ) -> None:
        self.texts = read_yaml(TEMPLATES / "pages.yaml")
        self.source, self.runs, self.studies = source, runs, studies.items()
        self.views = [TableView(result) for result in track(source)]
        self.every = claims_of(self.views)
        # The verdict of a claim by the most seeds at the largest scale counts.
        ranks = self.every["scale"].map({scale: rank for rank, scale in enumerate(SCALES)})
        order = self.every.assign(rank=ranks.fillna(-1)).sort_values(
            ["rank", "seeds"], kind="stable"
        )
        self.claims = order.drop_duplicates(["table", "claim"], keep="last").sort_index()
        self.remarks = source.remarks
        self.data = self._of_runs()
        known: dict[str, tuple[str, str]] = {
            name: (each["title"], each["reference"]) for name, each in self.texts["papers"].items()
        }
        known[STUDIES] = ("Studies", "Tables of this project that no paper prints.")
        known |= {
            v.name: (v.name, "Tables of the user.") for v in self.views if v.name not in known
        }
        self.papers = [PaperView(name, *each, self.views) for name, each in known.items()]

    def _of_runs(self) -> dict[str, Any]:
        """Runs by method, what they are about, and where they come from, as Markdown."""
        import pandas as pd

        rows, facts = [], []
        for run in self.runs:
            try:
                rows.append(self._scores(run))
                first = next(iter(run.provenance), {})
                packages, gpus = first.get("packages") or {}, ", ".join(first.get("gpus") or [])
                machine = gpus or f"{first['cpu']}, {first['cpu_usable']} cores"
                versions = {name: packages.get(name) for name in PACKAGES}
                commit = {"git commit": commit_of(first), "Python": first.get("python")}
                facts.append({**commit, **versions, "hardware": machine})
            except ODD as error:
                self.remarks.append(f"Run {run.key} is left out: {one_line(error)}.")
        if not rows:
            return {"runs": [], "origin": ""}
        frame, grids = pd.DataFrame(rows), []
        metrics = (names.MIOU, names.VAR)
        for (images, scale), kind in frame.groupby(["images", "scale"]):
            lines = []
            words = [method.split() for method in kind["method"]]
            every = [word for word in words[0][1:] if all(word in other for other in words)]
            for (method, _), each in kind.groupby(["method", "dataset"]):
                many = len(each) > 1
                scores = [
                    f"{number(each[name].mean())}{f' ± {number(each[name].std())}' * many}"
                    for name in metrics
                ]
                seeds = ", ".join(map(str, sorted(each["seed"])))
                tables = "; ".join(dict.fromkeys(name for run in each["tables"] for name in run))
                own = " ".join(word for word in method.split() if word not in every)
                lines.append((f"`{own}`", seeds, *scores, duration(each["time"].median()), tables))
            header = ("method", "seeds", *metrics, "time", "rows of")
            hours = duration(kind["time"].sum())
            title = f"{len(kind)} runs on {images} images, scale={scale}, {hours} in all"
            grid = markdown(TextTable(title, header, tuple(lines)))
            common = " ".join(word for word in every if word != f"scale={scale}")
            grids.append(f"{grid}\n\nAll of them with `{common}`." if common else grid)
        known = pd.DataFrame(facts)
        texts = {name: sorted(set(known[name].dropna()) - {""}) for name in known}
        origin = tuple((name, ", ".join(each) or ABSENT) for name, each in texts.items())
        return {"runs": grids, "origin": markdown(TextTable("", ("what", "value"), origin))}

    def _scores(self, run: RunResult) -> dict[str, Any]:
        """One line for each group of runs: its seeds, scores, time and tables."""
        tags, stored = run.tags, self.source.stored
        counts, basis = stored.counts(run, ()), stored.basis({"": {0: run}})
        return {
            "method": tags.get(GROUP, run.key),
            "dataset": counts.dataset,
            "images": basis.images,
            "scale": basis.scale,
            "seed": int(tags["rgbt.seed"]),
            **{name: value(name, counts, counts.absent) for name in (names.MIOU, names.VAR)},
            "time": float(run.result["seconds_of_last_process"]),
            "tables": sorted(t.removeprefix(TAG) for t in tags if t.startswith(TAG)),
        }

    @property
    def limits(self) -> list[str]:
        """What the verdicts do not say, one sentence or two each."""
        judged, said = self.every[self.every["verdict"] != "not run"], []
        if "paper" not in set(judged["scale"]):
            said.append(
                "**Networks:** no verdict is at paper scale. Small networks on small images say "
                "something about a method at that scale, and neither confirm nor refute a number."
            )
        for column, word, text in (
            ("images", "synthetic", "is on synthetic scenes: what these lack, it cannot show"),
            ("start", "one start for all seeds", "is from one start, see the warning beside it"),
            ("covers", "images", "is of one training: other trainings are not covered"),
        ):
            if count := int((judged[column] == word).sum()):
                said.append(f"**{column.capitalize()}:** the verdict of {count} claims {text}.")
        chance = f"**Chance:** of {len(judged)} claims without any effect, up to"
        return [*said, f"{chance} {0.025 * len(judged):.1f} would be called holding."]

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
        own = [view for view in self.views if view.is_run or view.name not in self.texts["papers"]]
        data = {
            **self.data,
            "num_runs": len(self.runs),
            "at_paper_scale": any("scale=paper" in each for each in self.data["runs"]),
            "remarks": self.remarks,
            "counts": markdown(counts_grid(self.claims)),
            "papers": self.papers,
            "limits": self.limits,
            "own": [view for view in own if view.is_run or view.name != STUDIES],
            "papers_tables": [view for view in self.views if view not in own],
            "studies": self.studies,
            "any_verdict": bool((self.claims["verdict"] != "not run").any()),
            **(_networks(self.texts["networks"]) if name == "networks" else {}),
        }
        paper = next((each for each in self.papers if each.name == name), None)
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
        for name, content in self.images.items():
            address = f"data:image/svg+xml;base64,{base64.b64encode(content).decode()}"
            body = body.replace(f'src="{name}"', f'src="{address}"')
        script = (TEMPLATES / "sort.js").read_text()
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        shell = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True)
        page = shell.get_template("page.html.j2")
        return page.render(body=body, script=script, hash=f"sha256-{digest}")

    @cached_property  # a second drawing has another layout
    def images(self) -> dict[str, bytes]:
        """The figures of the pages that were made, as SVG by the names of their files."""
        import tempfile

        from analysis.figures.plots import save

        with tempfile.TemporaryDirectory() as folder:
            for view in self.views:
                if view.drawn is not None:
                    save(view.drawn, Path(folder, view.figure))
            return {path.name: path.read_bytes() for path in Path(folder).iterdir()}

    def filled(self, text: str) -> str:
        """A page written by hand with its marked numbers made again.

        Marks: ``claim TABLE NAME`` is a claim with its verdict, ``count`` the number of claims of
        the papers and ``count runs`` that of runs, ``cell TABLE COLUMN ROW`` a mean over seeds with
        its standard deviation, ``effects TABLE OUTCOME`` the effects of a design on an outcome.
        InputError: a mark that names nothing.
        """
        return MARKED.sub(lambda mark: f"{mark[1]}{self._block(mark[2])}{mark[3]}", text)

    def _block(self, mark: str) -> str:
        kind, *words = mark.split()
        if mark == "count runs":
            return str(len(self.runs))
        if mark == "count":
            return str(int(self.claims["table"].str.contains("/").sum()))
        views = [view for view in self.views if view.result.request.name == words[0]]
        if kind == "claim":
            found = self.claims[(self.claims["table"] == words[0])]
            found = found[found["claim"] == words[1]]
            if len(found):
                row = found.iloc[0]
                command = f" (`rgbt reproduce table={words[0]} scale=bench seeds=4`)"
                return statement(row) + (command if row["verdict"] == "not run" else "")
        if kind == "cell" and views:
            cell = views[0].result.scored.cells.get((" ".join(words[2:]), words[1]))
            if cell is not None:
                return f"{number(cell.mean)} ± {number(cell.sd)}"
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
            words = (*each.get("overrides", ()), *f"model={model}".split())
            sizes.append((each["name"], f"`model={model}`", f"{million_parameters(words):.2f}"))
        weights += [(each["name"], file, f"<{address}>") for file, address in each["weights"]]
        tests.append((each["name"], ", ".join(f"`{test}`" for test in each["tests"])))
    grids = {
        "networks": TextTable("", ("network", "configuration", "million parameters"), tuple(sizes)),
        "weights": TextTable("", ("network", "file", "published at"), tuple(weights)),
        "tests": TextTable("", ("network", "test"), tuple(tests)),
    }
    return {name: markdown(grid) for name, grid in grids.items()}
