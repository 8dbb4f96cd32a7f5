"""Train one run, evaluate it, and write everything into its run folder."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from torch import nn

from rgbt.assembly.session import Session, names_key
from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.checks import InputError
from rgbt.engine.checkpoint import Checkpoints, State
from rgbt.engine.trainer import WAIT_SHARE, Trainer
from rgbt.evaluation.request import EvaluationRequest
from rgbt.evaluation.segmentation import evaluate, legend_of, panel_names, result_tables
from rgbt.metrics import names, scores
from rgbt.metrics.counts import Counts
from rgbt.processes import agreed, alone
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
from rgbt.runs.run_spec import RunSpec
from rgbt.runtime.signals import deferred
from rgbt.tables import ConsistencyTable, without_nan
from rgbt.terminal import info, warn
from rgbt.tracking.pictures import RegionHeat, draw_panel, draw_region_heat
from rgbt.tracking.tracker import Tracking
from rgbt.training.common import (
    fit,
    load_best,
    make_trainer,
    other_head_request,
    target_request,
)
from rgbt.training.members import training_together
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
    if spec.is_finished and not spec.fresh:
        show(spec, extra_tags)
        return
    description = describe(spec, extra_tags)
    tracking: Tracking = spec.tracking.build()
    folder = _train_unfinished(spec, tracking, description, upstream_of)
    if upstream_of:
        print_upstream_result(folder, description.name)
    else:
        print_result(spec, folder, tracking)


def _train_unfinished(
    spec: RunSpec, tracking: Tracking, description: Description, upstream_of: str
) -> RunFolder:
    """Train a run, in all processes of the command, and return its folder."""
    with training_together(spec) as start_others:
        # Everything is built before the folder is made: a wrong value leaves nothing behind.
        setup = set_up_training(spec)
        if upstream_of:
            announce_upstream(setup, description.name, upstream_of)
        else:
            announce_training(setup, description.name, spec.folder)
        if spec.is_finished:
            kept = set_aside(RunFolder(spec.folder))
            known = None if kept is None else read_description(kept.path)
            if kept is not None and known is not None:
                tracking.refresh(kept, known)
        folder = RunFolder(spec.folder)
        with folder.lock():
            start_others()
            Run(setup, folder, tracking, description).complete()
    return folder


@dataclass(frozen=True)
class Run:
    """An unfinished run: trains, evaluates and fills its folder."""

    setup: TrainingSetup
    folder: RunFolder
    tracking: Tracking
    description: Description

    def complete(self) -> None:
        """Train to the last step, evaluate the best checkpoint, write the result."""
        started = time.time()
        session = self.setup.session
        self._claim(session)
        tags = {**self.description.tags, "rgbt.key": self.folder.path.name}
        try:
            self.tracking.start(self.folder, replace(self.description, tags=tags))
            state = self._train(session)
            lines = self.folder.lines()
            self._report(session, lines)
            agreed(None)  # the other processes may read the best checkpoint
            load_best(session, self.folder.path, state.best_step)
            with alone():
                pairs = self._consistency(session)
            tested = self._test(session, state, pairs.get("test"))
            Checkpoints(self.folder.path).tidy()
            self.folder.finish(
                {
                    "name": self.description.name,
                    "key": self.folder.path.name,
                    "dataset": session.dataset.fingerprint(),
                    "steps": state.step,
                    "best_step": state.best_step,
                    **({"best_score": state.best_score} if session.selection_split else {}),
                    "seconds_of_last_process": round(time.time() - started, 1),
                    "skipped": state.skipped,
                    **self._scores(session, state, lines, {"test": tested}, pairs),
                }
            )
        except KeyboardInterrupt:
            self.tracking.finish("KILLED")
            raise
        except BaseException:
            # The tracker must not show a run that raised as running.
            self.tracking.finish("FAILED")
            raise
        with deferred():  # a signal must not leave a finished run as running in the store
            self.tracking.finish("FINISHED")

    def _scores(
        self,
        session: Session,
        state: State,
        lines: Sequence[MetricLine],
        reached: dict[str, dict[str, float]],
        pairs: Mapping[str, ConsistencyTable],
    ) -> dict[str, dict[str, float | None]]:
        """Scores of the best checkpoint on the selection split, if any, and on the test split."""
        if session.selection_split is not None:
            of_val = {line.step: line.values for line in lines if line.kind == "val"}
            val = of_val.get(state.best_step)
            if not val:  # the log was cut off, which is reported
                path = self.folder.path / counts_name(session.selection_split)
                val = scores.summary(Counts.load(path), session.regions.absent)
            reached = {"val": val, **reached}
        for kind, table in pairs.items():
            reached[kind] = {**reached[kind], **_values_of(table)}
        return {kind: without_nan(values) for kind, values in reached.items()}

    def _claim(self, session: Session) -> None:
        """Write what identifies the run; refuse a folder that was started on other images."""
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

    def _train(self, session: Session) -> State:
        state = State(seed=session.spec.drawn.masks)
        trainer = self._trainer(session, state)
        if agreed(trainer.resume(state)):
            info(f"{self.description.name} resumes at step {state.step} ({self.folder.path}).")
        own_code = {"own_code": session.spec.own_code(), "from_step": state.step}
        self.folder.add_provenance({**provenance(), **own_code})
        warn_of_steps(self.folder.path, state.step)
        self._truncate(state)
        fit(trainer, self.setup, state)
        return state

    def _truncate(self, state: State) -> None:
        """Prepare ``metrics.jsonl`` of a run that resumes; report what is repeated or lost."""
        step = state.step
        lines = self.folder.truncate_after(step, state.evaluated_step)
        reached = max((line.step for line in lines), default=0)
        if reached > step:
            info(f"steps {step + 1} to {reached} were not saved and are repeated.")
        logged = [0, *(line.step for line in lines if line.kind == "train" and line.step <= step)]
        every = max([self.setup.session.trainer.log_every, *(np.diff(logged[-2:]).tolist())])
        if step - logged[-1] >= every:
            warn(
                f"{self.folder.path / 'metrics.jsonl'} ends at step {logged[-1]}, but the "
                f"checkpoint is of step {step}. The lines in between are missing; counts and "
                "checkpoint are not affected."
            )

    def _report(self, session: Session, lines: Sequence[MetricLine]) -> None:
        """Report a training that mostly waited for images, what helps, and shares of gradients."""
        logged = [line.values for line in lines if line.kind == "train"]
        shares = [values[WAIT_SHARE] for values in logged if WAIT_SHARE in values]
        if shares and np.median(shares) > MUCH_WAITING:
            cache = (
                "" if session.loading.cache else "data.cache=auto decodes every image once, and "
            )
            info(
                f"{np.median(shares):.0%} of the time of a step was spent waiting for images; "
                f"{cache}data.num_workers=... reads them with more processes."
            )
        if session.trainer.log_gradient_shares:
            from rgbt.engine.gradient_shares import shares_sentence

            if sentence := shares_sentence(logged):
                info(f"{sentence}.")

    def _trainer(self, session: Session, state: State) -> Trainer:
        split = session.selection_split

        def validate(step: int) -> float:
            assert split is not None, "called only where there is one"
            result = evaluate(session, self.setup.model, EvaluationRequest(split=split))
            folder = trainer.checkpoints.begin_evaluation(step)
            result.counts.save(folder / counts_name(split))
            values = scores.summary(result.counts, session.regions.absent)
            values |= self._of_target(session, self.setup.model, split, folder)
            self.folder.append(step, "val", values)
            state.skip(result.skipped)
            return values[names.MIOU]

        trainer = make_trainer(
            self.setup,
            self.folder.path,
            record=lambda step, values: self.folder.append(step, "train", values),
            validate=None if split is None else validate,
            committed=self.tracking.update,
            after_step=self.tracking.after_step,
        )
        return trainer

    def _consistency(self, session: Session) -> dict[str, ConsistencyTable]:
        """TC and CA of the best checkpoint under "val" and "test", as far as requested."""
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

    def _test(
        self, session: Session, state: State, pairs: ConsistencyTable | None
    ) -> dict[str, float]:
        """Counts, tables and figures of the best checkpoint on the test split; its scores."""
        keep = panel_names(session.dataset, "test")
        result = evaluate(session, session.model, EvaluationRequest(split="test", keep=keep))
        state.skip(result.skipped)
        result.counts.save(self.folder.path / counts_name("test"))
        values = scores.summary(result.counts, session.regions.absent)
        of_target = self._of_target(session, session.model, "test", self.folder.path)
        by_other = self._by_other_head(session)
        values |= of_target | by_other | ({} if pairs is None else _values_of(pairs))
        self.folder.append(state.step, "test", values)
        name = self.description.name
        tables = result_tables(result.counts, session.regions, name, state.best_step)
        # As rows of the table: "thermal", "thermal, day", "source head, night".
        parts = {
            ", ".join(each.replace("_", " ").split("/")[:-1]): value
            for each, value in (of_target | by_other).items()
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

    def _by_other_head(self, session: Session) -> dict[str, float]:
        """The mIoU at night of the head that is not selected for the night, named after the head.

        Its counts are written to the run folder.
        """
        request = other_head_request(session)
        if request is None:
            return {}
        assert request.head is not None, "the request names a head"
        counts = evaluate(session, session.model, request).counts
        counts.save(self.folder.path / counts_name(f"test_{request.head}_head"))
        values = scores.summary(counts, session.regions.absent)
        at_night = names.subset(names.NIGHT, names.MIOU)
        kept = {at_night: values[at_night]} if at_night in values else {}
        return {names.by_head(request.head, name): value for name, value in kept.items()}

    def _of_target(
        self, session: Session, model: nn.Module, split: str, folder: Path
    ) -> dict[str, float]:
        """The mIoU in the view of the target, if that is not the source's, named after the view.

        Its counts are written to `folder`.
        """
        request = target_request(session, split)
        if request is None or request.view is None:
            return {}
        counts = evaluate(session, model, request).counts
        counts.save(folder / counts_name(f"{split}_{request.view}"))
        values = scores.summary(counts, session.regions.absent)
        kept = (names.MIOU, *(names.subset(part, names.MIOU) for part in (names.DAY, names.NIGHT)))
        return {names.subset(request.view, name): values[name] for name in kept if name in values}


def _values_of(table: ConsistencyTable) -> dict[str, float]:
    from rgbt.evaluation.temporal_consistency import consistency_values

    return consistency_values(table)
