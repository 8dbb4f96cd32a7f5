"""Names of the user attributes of trials and studies in Optuna's storage."""

from __future__ import annotations

KEY = "rgbt.key"
"""Key of the point: its run keys, or one of them where it has one run."""

RUNS = "rgbt.runs"
"""Keys of the runs that the point is made of, one per seed."""

OVERRIDES = "rgbt.overrides"
"""Overrides of `python -m rgbt.run`, without the seeds of replicates."""

LABEL = "rgbt.label"
OWNER = "rgbt.owner"
"""Driver of the trial: host, process, start of the process, see `worker.trial_store.Owner`."""

HEARTBEAT = "rgbt.beat"
"""Time of the owner's last heartbeat, seconds since 1970."""

TOKEN = "rgbt.token"
"""Random text that identifies the trial that a driver has added."""

REASON = "rgbt.reason"
"""Why the trial failed, was pruned or dropped, in one sentence."""

REPLACES = "rgbt.replaces"
"""Of a trial that was enqueued again: number of the trial that its driver left unfinished."""

DROPPED = "rgbt.dropped"
"""True: the trial does not count, another one has the same point."""

SECONDS = "rgbt.seconds"
"""Duration of the point's runs, all processes together."""

RESULTS = "rgbt.results"
""""val/..." and "test/..." scores of the point, mean over its seeds; percent, Var as it is."""

PIXELS = "rgbt.pixels"
"""Size of the point's images relative to the paper's, by which ``${px:64}`` is scaled."""

KIND = "rgbt.kind"
"""Of a study: "search", "grid" or "list"."""

SIGNATURE = "rgbt.signature"
"""Of a study: hash of its space and objectives, which must not change."""

METRICS = "rgbt.metrics"
"""Of a study: names of the objectives, in order."""

COMMAND = "rgbt.command"
"""Of a study: the command that created it."""
