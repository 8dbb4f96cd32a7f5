"""Train one run, evaluate it, and write everything into its run folder.

Of several processes of a run, each trains and evaluates its part; process 0 writes and reports.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from torch import nn

from rgbt.assembly.session import names_key
from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.checks import InputError
from rgbt.data.domains import TestedHead
from rgbt.engine.checkpoint import Checkpoints, State, restore_weights
from rgbt.engine.trainer import WAIT_SHARE, Loaded, Trainer
from rgbt.evaluation.prediction import view_of
from rgbt.evaluation.request import EvaluationRequest
from rgbt.evaluation.segmentation import (
    EvaluationResult,
    evaluate,
    legend_of,
    panel_names,
    result_tables,
)
from rgbt.metrics import names, scores
from rgbt.metrics.counts import Counts
from rgbt.processes import agreed, alone, rank
from rgbt.runs.folder import (
    Description,
    MarkerForm,
    MetricLine,
    RunFolder,
    counts_name,
    read_description,
    read_marker,
    set_aside,
)
from rgbt.runs.naming import describe
from rgbt.runs.provenance import provenance, warn_of_steps, without_passwords
from rgbt.runs.run_spec import RunSpec, settings_digest
from rgbt.runtime.signals import deferred
from rgbt.tables import ConsistencyTable, without_nan
from rgbt.terminal import info, warn
from rgbt.tracking.pictures import RegionHeat, draw_panel, draw_region_heat
from rgbt.tracking.tracker import Tracking
from rgbt.training.overview import announce_training, announce_upstream
from rgbt.training.show import print_result, print_upstream_result, show

MUCH_WAITING = 0.3
"""Share of a step spent waiting for images above which a warning is printed."""


def train(
    spec: RunSpec, extra_tags: Mapping[str, str] | None = None, upstream_of: str = ""
) -> None:
    """Train a run to its end, or resume it, and print its result.

    Args:
        spec: the run; its upstream runs are finished.
        extra_tags: MLflow tags of the run (see `rgbt.runs.naming.describe`).
        upstream_of: name of the run that needs this one, which is announced in one line, as is its
            result; "": the requested run, with all tables.

    Raises:
        InputError: the configuration, the data or the run folder do not fit.
        RunError: the training failed.
    """
    if agreed(spec.is_finished) and not spec.fresh:
        if rank() == 0:
            show(spec, extra_tags)
        return
    description = describe(spec, extra_tags)
    # Everything is built before the folder is made: a wrong value leaves nothing behind.
    setup = set_up_training(spec)
    if upstream_of:
        announce_upstream(setup, description.name, upstream_of)
    else:
        announce_training(setup, description.name, spec.folder)
    if rank() > 0:
        Training(setup, SilentFolder(spec.folder), Tracking(), description).complete()
        return
    tracking: Tracking = spec.tracking.build()
    if spec.is_finished:
        kept = set_aside(RunFolder(spec.folder))
        known = None if kept is None else read_description(kept.path)
        if kept is not None and known is not None:
            tracking.refresh(kept, known)
    folder = RunFolder(spec.folder)
    with folder.lock():
        Training(setup, folder, tracking, description).complete()
    if upstream_of:
        print_upstream_result(folder, description.name)
    else:
        print_result(spec, folder, tracking)


class SilentFolder(RunFolder):
    """The run folder for the processes that write nothing."""

    def __init__(self, path: Any) -> None:
        self.path = path

    def _nothing(self, *_: object) -> None:
        """Write nothing."""

    write_config = add_provenance = describe = append = finish = mark = _nothing  # type: ignore[assignment]

    def truncate_after(self, *_: object) -> list[MetricLine]:
        """No lines."""
        return []

    lines = truncate_after


@dataclass(frozen=True)
class Training:
    """The training of one run: trains, evaluates and fills its folder.

    `selected` are the counts of the last evaluation on the selection split, by the split and view.
    """

    setup: TrainingSetup
    folder: RunFolder
    tracking: Tracking
    description: Description
    selected: dict[str, Counts] = field(default_factory=dict)

    def complete(self) -> None:
        """Train to the last step, evaluate the best checkpoint, write the result."""
        started = time.time()
        session = self.setup.session
        self._claim()
        tags = {**self.description.tags, "rgbt.key": self.folder.path.name}
        with self._tracked():
            self.tracking.start(self.folder, replace(self.description, tags=tags))
            settings = settings_digest(session.spec.plain)
            key = self.folder.path.name
            state = State(seed=session.spec.drawn.masks, key=key, settings=settings)
            trainer = self._trainer(state)
            self._resume(trainer, state)
            accumulate = session.trainer.accumulate
            steps = range(state.step * accumulate, session.trainer.max_steps * accumulate)
            trainer.fit(self._batches(steps, state), state)
            lines = self.folder.lines()
            self._report(lines)
            agreed(None)  # process 0 has written the best checkpoint
            checkpoints = Checkpoints(self.folder.path)
            restore_weights(session.model, checkpoints.load_best(state), checkpoints.best)
            pairs = self._consistency() if rank() == 0 else {}
            reached = {"test": self._test(state, pairs.get("test"))}
            if session.selection_split is not None:
                reached = {"val": self._selection_scores(state, lines), **reached}
            for kind, table in pairs.items():
                reached[kind] = {**reached[kind], **_values_of(table)}
            result = {
                "name": self.description.name,
                "key": self.folder.path.name,
                "dataset": session.dataset.fingerprint(),
                "steps": state.step,
                "best_step": state.best_step,
                **({"best_score": state.best_score} if session.selection_split else {}),
                "seconds_of_last_process": round(time.time() - started, 1),
                "skipped": state.skipped,
                **{kind: without_nan(values) for kind, values in reached.items()},
            }
            self.folder.finish(result)

    @contextmanager
    def _tracked(self) -> Iterator[None]:
        """Tell the tracker how the block ended: it must not show a run that raised as running."""
        try:
            yield
        except BaseException as error:
            self.tracking.finish("KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
            raise
        with deferred():  # a signal must not leave a finished run as running in the store
            self.tracking.finish("FINISHED")

    def _claim(self) -> None:
        """Write what identifies the run; refuse a folder that was started on other images."""
        session = self.setup.session
        dataset = session.dataset
        now: MarkerForm = {"names": names_key(session), "files": dataset.fingerprint()}
        before = read_marker(self.folder.path) or now
        if before["names"] != now["names"]:
            raise InputError(
                f"{self.folder.path} was started on other images than those listed in "
                f"{dataset.root}. Choose another folder of runs (runs_dir=...) or another name of "
                "the data set (dataset.name=...)."
            )
        if before["files"] != now["files"]:
            info(f"files of {dataset.root} have changed since this run was started.")
        self.folder.mark(now)
        config = OmegaConf.to_yaml(OmegaConf.create(dict(session.spec.plain)))
        self.folder.write_config(without_passwords(config))

    def _resume(self, trainer: Trainer, state: State) -> None:
        """Restore the last checkpoint, if any; report what is repeated or lost."""
        if trainer.resume(state):
            info(f"{self.description.name} resumes at step {state.step} ({self.folder.path}).")
        own_code = {"own_code": self.setup.session.spec.own_code(), "from_step": state.step}
        self.folder.add_provenance({**provenance(), **own_code})
        warn_of_steps(self.folder.path, state.step)
        step = state.step
        lines = self.folder.truncate_after(step, state.evaluated_step)
        reached = max((line.step for line in lines), default=0)
        if reached > step:
            info(f"steps {step + 1} to {reached} were not saved and are repeated.")
        logged = [0, *(line.step for line in lines if line.kind == "train" and line.step <= step)]
        every = max([trainer.settings.log_every, *(np.diff(logged[-2:]).tolist())])
        if step - logged[-1] >= every:
            warn(
                f"{self.folder.path / 'metrics.jsonl'} ends at step {logged[-1]}, but the "
                f"checkpoint is of step {step}. The lines in between are missing; counts and "
                "checkpoint are not affected."
            )

    def _report(self, lines: Sequence[MetricLine]) -> None:
        """Report a training that mostly waited for images, and what helps."""
        logged = [line.values for line in lines if line.kind == "train"]
        shares = [values[WAIT_SHARE] for values in logged if WAIT_SHARE in values]
        if shares and np.median(shares) > MUCH_WAITING:
            cached = self.setup.session.loading.cache
            cache = "" if cached else "data.cache=auto decodes every image once, and "
            info(
                f"{np.median(shares):.0%} of the time of a step was spent waiting for images; "
                f"{cache}data.num_workers=... reads them with more processes."
            )

    def _trainer(self, state: State) -> Trainer:
        setup, session = self.setup, self.setup.session
        split, settings = session.selection_split, session.trainer

        def validate(step: int) -> float:
            assert split is not None, "called only where there is one"
            result, of_target = self._evaluate(trainer.weights.network, split, self.selected)
            values = scores.summary(result.counts, session.regions.absent) | of_target
            self.folder.append(step, "val", values)
            state.skip(result.skipped)
            return values[names.MIOU]

        trainer = Trainer(
            fabric=setup.fabric,
            settings=settings,
            scheme=setup.scheme,
            model=session.model,
            others=setup.others,
            optimizers=setup.optimizers,
            schedule=setup.schedule,
            steps_per_epoch=max(1, setup.steps_per_epoch() // settings.accumulate),
            folder=self.folder.path,
            record=lambda step, values: self.folder.append(step, "train", values),
            validate=None if split is None else validate,
            keep=lambda: self._save(self.selected),
            committed=self.tracking.update,
            after_step=self.tracking.after_step,
        )
        return trainer

    def _batches(self, steps: range, state: State) -> Iterator[Loaded]:
        """The batches, with unreadable files noted in `state` before a checkpoint is written."""
        batches = self.setup.batches(steps)
        for batch in batches:
            state.skip(batches.skipped)
            yield batch

    def _evaluate(
        self, network: nn.Module, split: str, counts: dict[str, Counts], keep: Sequence[str] = ()
    ) -> tuple[EvaluationResult, dict[str, float]]:
        """Evaluate a split, also in the view of the target where that is not the source's.

        The counts are added to `counts`. Returns the evaluation, and the mIoU in the view of the
        target by names that begin with the view.
        """
        session = self.setup.session
        result = evaluate(session, network, EvaluationRequest(split=split, keep=tuple(keep)))
        counts[split] = result.counts
        view = None if session.domains.target is None else session.domains.target.view
        if view is None or view == view_of(session):
            return result, {}
        found = evaluate(session, network, EvaluationRequest(split=split, view=view)).counts
        counts[f"{split}_{view}"] = found
        values = scores.summary(found, session.regions.absent)
        kept = (names.MIOU, *(names.subset(part, names.MIOU) for part in (names.DAY, names.NIGHT)))
        return result, {names.subset(view, name): values[name] for name in kept if name in values}

    def _save(self, counts: Mapping[str, Counts]) -> None:
        for name, each in counts.items() if rank() == 0 else ():
            each.save(self.folder.path / counts_name(name))

    def _selection_scores(self, state: State, lines: Sequence[MetricLine]) -> dict[str, float]:
        """Scores of the best checkpoint on the selection split."""
        for line in lines:
            if line.kind == "val" and line.step == state.best_step:
                return line.values
        # The log was cut off, which is reported.
        split = self.setup.session.selection_split
        assert split is not None, "called only where there is one"
        counts = Counts.load(self.folder.path / counts_name(split))
        return scores.summary(counts, self.setup.session.regions.absent)

    @alone()
    def _consistency(self) -> dict[str, ConsistencyTable]:
        """TC and CA of the best checkpoint under "val" and "test", as far as requested."""
        session = self.setup.session
        tables: dict[str, ConsistencyTable] = {}
        if not session.consistency.sets:
            return tables
        from rgbt.evaluation.pair_frames import Pairing
        from rgbt.evaluation.temporal_consistency import consistency_table, count_pairs
        from rgbt.metrics.pairs import file_name
        from rgbt.tracking.pair_pictures import draw_pairs

        for kind in session.consistency.splits:
            split = session.selection_split if kind == "val" else kind
            if split is None:
                info(f"consistency was not measured on val: {session.dataset.name} has none.")
                continue
            keep = panel_names(session.dataset, split) if kind == "test" else ()
            try:
                request = EvaluationRequest(split=split, keep=keep)
                pairs = count_pairs(session, session.model, request, Pairing("virtual"))
            except InputError as error:
                # The training is done: an error of an extra evaluation must not lose it.
                info(
                    f"{error} Consistency was not measured; measure it later with `rgbt "
                    "consistency`."
                )
                continue
            for protocol, counts in pairs.counts.items():
                path = self.folder.path / file_name(protocol, split, session.consistency.mark)
                path.parent.mkdir(exist_ok=True)
                counts.save(path)
            tables[kind] = consistency_table(pairs.counts, session.regions.absent)
            if pairs.kept:
                draw_pairs(pairs.kept, legend_of(session.dataset), self.folder.figure_path("pairs"))
        return tables

    def _test(self, state: State, pairs: ConsistencyTable | None) -> dict[str, float]:
        """Counts, tables and figures of the best checkpoint on the test split; its scores."""
        session, counts = self.setup.session, dict[str, Counts]()
        keep = panel_names(session.dataset, "test")
        result, beside = self._evaluate(session.model, "test", counts, keep)
        beside |= self._by_other_head(counts)
        state.skip(result.skipped)
        self._save(counts)
        values = scores.summary(result.counts, session.regions.absent) | beside
        values |= {} if pairs is None else _values_of(pairs)
        self.folder.append(state.step, "test", values)
        if rank() > 0:
            return values
        name = self.description.name
        tables = result_tables(result.counts, session.regions, name, state.best_step)
        # As rows of the table: "thermal", "thermal, day", "source head, night".
        parts = {
            ", ".join(each.replace("_", " ").split("/")[:-1]): value
            for each, value in beside.items()
        }
        subsets = {**tables.classes.subset_mious, **parts}
        classes = replace(tables.classes, subset_mious=subsets)
        tables = replace(tables, classes=classes, consistency=pairs)
        self.folder.write_tables(tables)
        if not result.kept:
            info("no image of the panel could be read, so no pictures were drawn.")
            return values
        draw_panel(result.kept, legend_of(session.dataset), self.folder.figure_path("panel"))
        heat = RegionHeat(
            title=f"{name}: IoU by region, {session.dataset.name} {tables.split}",
            region_map=session.regions.map(result.kept[0].label.shape).astype(np.int64),
            ious=tables.regions.region_ious,
        )
        draw_region_heat(heat, self.folder.figure_path("regions"))
        return values

    def _by_other_head(self, counts: dict[str, Counts]) -> dict[str, float]:
        """The mIoU at night of the head that is not selected for the night, named after the head.

        Nothing in a run without a head for the day and another one for the night. Its counts are
        added to `counts`.
        """
        session = self.setup.session
        if session.domains.target_is != "night":
            return {}
        head: TestedHead = "target" if session.domains.tested_head == "source" else "source"
        request = EvaluationRequest(split="test", head=head)
        found = evaluate(session, session.model, request).counts
        counts[f"test_{head}_head"] = found
        values = scores.summary(found, session.regions.absent)
        at_night = names.subset(names.NIGHT, names.MIOU)
        return {names.by_head(head, at_night): values[at_night]} if at_night in values else {}


def _values_of(table: ConsistencyTable) -> dict[str, float]:
    from rgbt.evaluation.temporal_consistency import consistency_values

    return consistency_values(table)
