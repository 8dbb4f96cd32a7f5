"""The page claims.md: every claim with its verdict, what was run for it, how long that took."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from statistics import median

from analysis.report.claim_views import (
    IMAGES,
    VERDICTS,
    PaperClaims,
    needed,
    paper_claims,
    seeds,
)
from analysis.report.data import ReportData, RunEntry
from analysis.report.markdown_claims import counts_table
from analysis.report.markdown_tables import markdown_table
from analysis.report.results_file import Paper
from analysis.report.views import (
    DASH,
    Group,
    TableView,
    duration,
    fixed,
    groups_of,
    interval_text,
    plural,
    with_sign,
)
from sweeps.table.request import DEFAULT_SCALE

UPSTREAM = re.compile(r"(?:experiment|common):([\w-]+)/")
"""In a setting, the experiment of an upstream run."""

ONE_START = "seeds.start=common"
"""The override by which all seeds of a table begin with the same weights."""

CHANCE = 0.025
"""Share of claims without an effect that are called holding."""


def verdicts_context(
    data: ReportData, tables: Sequence[TableView], papers: Mapping[str, Paper]
) -> dict[str, object]:
    """What the template of claims.md shows.

    Verdicts at demo scale are left to the page index.md where there are verdicts at other scales.

    Args:
        data: of the store.
        tables: its tables with their places.
        papers: pages of tables by name.
    """
    claims = paper_claims(tables)
    run = [paper for paper in claims if paper.judged]
    scales = sorted({paper.scale for paper in run})
    shown_scales = [scale for scale in scales if scale != DEFAULT_SCALE] or scales
    shown = [paper for paper in run if paper.scale in shown_scales]
    arms = arms_of(data.runs, shown)
    return {
        "sections": [(_title(paper, papers), paper, verdict_table(paper)) for paper in shown],
        "shown_scales": shown_scales,
        "other_scales": [scale for scale in scales if scale not in shown_scales],
        "claim_counts": counts_table(shown),
        "not_run": [(_title(paper, papers), waiting_tables(paper, claims)) for paper in shown],
        "never_run": [_title(each, papers) for each in _without_section(claims, shown)],
        "arms": arms_table(arms, data.runs),
        "keys": [(arm.name, [run.key for run in _by_seed(arm.runs)]) for arm in arms],
        "time": time_sentences(arms, data.runs),
        "limits": limits(shown, [run for arm in arms for run in arm.runs]),
    }


def _title(paper: PaperClaims, papers: Mapping[str, Paper]) -> str:
    known = papers.get(paper.paper)
    title = known.title if known is not None else paper.paper.capitalize()
    return ", ".join(filter(None, (title, paper.run_as)))


def _without_section(
    claims: Iterable[PaperClaims], shown: Sequence[PaperClaims]
) -> list[PaperClaims]:
    """The papers without a verdict at the shown scales, once each."""
    there = {paper.paper for paper in shown}
    missing = {paper.paper: paper for paper in claims if paper.paper not in there}
    return list(missing.values())


def verdict_table(paper: PaperClaims) -> str:
    """One line per judged claim: statement, printed value, ours with interval, verdict, seeds."""
    header = [
        *("claim", "contrast", "printed", "ours", "95 % interval", "can show", "seeds"),
        *("would decide", "verdict"),
    ]
    rows = []
    for each in paper.judged:
        entry = each.entry
        rows.append(
            [
                f"{entry.says} ({each.view.entry.number})",
                entry.contrast,
                with_sign(entry.printed),
                with_sign(entry.estimate),
                interval_text(entry.low, entry.high)
                + (f" ({IMAGES})" if entry.covers == "images" else ""),
                fixed(entry.smallest),
                seeds(entry),
                needed(entry),
                VERDICTS[entry.verdict],
            ]
        )
    return markdown_table(header, rows, (0, 1, 8))


def waiting_tables(paper: PaperClaims, claims: Sequence[PaperClaims]) -> list[str]:
    """Per table the claims without a verdict here, and those that have one in another way."""
    elsewhere: dict[tuple[str, str], list[str]] = {}
    for other in claims:
        if other.paper == paper.paper and other is not paper:
            for each in other.judged:
                place = (each.view.entry.name, each.entry.name)
                elsewhere.setdefault(place, []).append(f"{other.run_as}: {each.entry.verdict}")
    lines: dict[str, list[str]] = {}
    for each in paper.claims:
        if each.entry.verdict == "not run":
            found = elsewhere.get((each.view.entry.name, each.entry.name), [])
            shown = f"`{each.entry.name}`" + (f" ({'; '.join(found)})" if found else "")
            lines.setdefault(each.view.entry.number, []).append(shown)
    return [f"{number}: {', '.join(names)}." for number, names in lines.items()]


def arms_of(runs: Iterable[RunEntry], papers: Iterable[PaperClaims]) -> list[Group]:
    """The finished runs behind the verdicts, by method."""
    keys = {key for paper in papers for each in paper.judged for key in each.entry.runs}
    groups = groups_of(run for run in runs if run.key in keys and run.status == "FINISHED")
    return sorted(groups, key=lambda group: (group.runs[0].scale, group.name))


def upstream_of(arms: Iterable[Group], runs: Iterable[RunEntry]) -> list[RunEntry]:
    """The finished runs of the experiments that runs of `arms` name, with those upstream of them.

    Args:
        arms: groups of runs.
        runs: of the store.
    """
    finished = [run for run in runs if run.status == "FINISHED"]
    behind = [run for arm in arms for run in arm.runs]
    own = {run.key for run in behind}
    found: dict[str, RunEntry] = {}
    while behind:
        named = {
            (name, run.scale)
            for run in behind
            for value in run.config.values()
            for name in UPSTREAM.findall(value)
        }
        behind = [
            run
            for run in finished
            if (run.experiment, run.scale) in named and run.key not in {*own, *found}
        ]
        found |= {run.key: run for run in behind}
    return list(found.values())


def arms_table(arms: Sequence[Group], runs: Sequence[RunEntry]) -> str:
    """Method, rows, seeds and wall time of every arm, then of the upstream runs; "" of none."""
    rows = [
        [f"`{arm.name}`", _rows(arm.runs), str(len(arm.runs)), *_times(arm.runs)] for arm in arms
    ]
    for group in groups_of(upstream_of(arms, runs)):
        line = [f"`{group.name}`", "upstream run", str(len(group.runs)), *_times(group.runs)]
        rows.append(line)
    header = ["arm", "rows of tables", "seeds", "wall time of a run", "in total"]
    return markdown_table(header, rows, (0, 1)) if rows else ""


def _rows(runs: Sequence[RunEntry]) -> str:
    """Tables and rows that the runs belong to."""
    places = {f"{table}: {row}": None for run in runs for table, row in run.table_rows.items()}
    return "; ".join(places) or DASH


def _times(runs: Sequence[RunEntry]) -> list[str]:
    known = [run.seconds for run in runs if run.seconds is not None]
    return [_seconds(median(known)), duration(sum(known))] if known else [DASH, DASH]


def _seconds(seconds: float) -> str:
    """Seconds as such below ten minutes, because minutes are too coarse for runs of a few."""
    return f"{seconds:.0f} s" if seconds < 600 else duration(seconds)


def _by_seed(runs: Iterable[RunEntry]) -> list[RunEntry]:
    return sorted(runs, key=lambda run: -1 if run.seed is None else run.seed)


def time_sentences(arms: Sequence[Group], runs: Sequence[RunEntry]) -> list[str]:
    """How long all runs took, and what the times do not contain."""
    behind = [run for arm in arms for run in arm.runs]
    upstream = upstream_of(arms, runs)
    known = [run.seconds for run in [*behind, *upstream] if run.seconds is not None]
    if not known:
        return []
    counted = plural(len(behind), "run") + f" of {plural(len(arms), 'arm')}"
    more = f" and {plural(len(upstream), 'upstream run')}" if upstream else ""
    hardware = Counter(run.hardware for run in behind if run.hardware).most_common()
    machines = f" on {', '.join(name for name, _ in hardware)}" if hardware else ""
    sentences = [
        f"{counted}{more} took {duration(sum(known))} in total{machines}.",
        "The wall time of a run contains its evaluations during and after training. It does not "
        "contain the further evaluations of tables. Other processes may have shared the cores.",
    ]
    resumed = sum(run.resumed for run in behind)
    if resumed:
        verb = "was" if resumed == 1 else "were"
        pauses = f"{plural(resumed, 'run')} {verb} interrupted and resumed; the pauses are counted."
        sentences.append(pauses)
    return sentences


def limits(papers: Sequence[PaperClaims], runs: Sequence[RunEntry]) -> list[str]:
    """What the verdicts do not say, one sentence or two each."""
    claims = [each for paper in papers for each in paper.judged]
    judged = [each.entry for each in claims]
    scales = sorted({run.scale for run in runs})
    sentences = []
    if "paper" not in scales:
        sentences.append(
            f"**Networks:** all runs are at {' and '.join(scales) or 'no'} scale, with small "
            "networks and small images. A verdict is about the method at this scale; it neither "
            "confirms nor refutes a number of a paper."
        )
    synthetic = sum(".synth" in run.config.get("dataset._target_", "") for run in runs)
    if synthetic:
        sentences.append(
            f"**Data:** {synthetic} of {plural(len(runs), 'run')} are on synthetic scenes. What "
            "the scenes lack, no verdict can show."
        )
    one_start = sum(ONE_START in shlex.split(each.view.entry.extra) for each in claims)
    if one_start:
        sentences.append(
            f"**Start:** the verdict of {plural(one_start, 'claim')} is from runs that all begin "
            f"with one common start (`{ONE_START}`). Its interval does not contain the spread "
            "between starts."
        )
    stopped = sum(each.seeds_needed == float("inf") for each in judged)
    if stopped:
        sentences.append(
            f"**Images:** {plural(stopped, 'claim')} cannot be decided by more seeds, because the "
            "test images leave them open. More test images would be needed."
        )
    single = sum(each.covers == "images" and each.seeds == 1 for each in judged)
    if single:
        sentences.append(
            f"**Trainings:** the verdict of {plural(single, 'claim')} is of one seed. The interval "
            "is over images alone and does not cover the spread of trainings."
        )
    if judged:
        sentences.append(
            f"**Chance:** of {plural(len(judged), 'claim')} without any effect, up to "
            f"{CHANCE * len(judged):.1f} would be called holding."
        )
    return sentences
