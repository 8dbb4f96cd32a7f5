"""Train one run, evaluate it, and write everything into its run folder.

Of several processes of a run, each trains and evaluates its part. Process 0 writes: `train_run`
decides that where it opens the run folder (`RunFolder.writes`), and nothing else does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

from omegaconf import OmegaConf
from torch import nn

from rgbt.assembly.load_run import with_weights
from rgbt.assembly.session import Session, names_key
from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.checks import InputError
from rgbt.data.domains import TestedHead
from rgbt.engine.checkpoint import BEST, State, load_best, restore_weights
from rgbt.engine.memory import naming_memory, training_advice
from rgbt.engine.trainer import Hooks, StepData, Trainer, Values
from rgbt.evaluation.measure import (
    Measured,
    draw_extremes,
    measure,
    measurement_of,
    panel_names,
    path_of,
)
from rgbt.evaluation.predict import view_of
from rgbt.evaluation.tables import result_tables
from rgbt.metrics import names, scores
from rgbt.metrics.counts import Counts
from rgbt.processes import computed_once, rank
from rgbt.requirements import NetworkRecord, TransformRecord, record_of
from rgbt.runs.folder import (
    Description,
    Marker,
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
from rgbt.terminal import info
from rgbt.tracking.pictures import draw_panel, draw_region_heat
from rgbt.tracking.tracker import Tracking
from rgbt.training.report import (
    announce_training,
    announce_upstream,
    print_result,
    print_upstream_result,
)


def predict_labels(spec: RunSpec) -> None:
    """Predict the pseudo-labels that a run lacks, with the networks of its upstream runs."""
    for teacher, domain, folder in spec.missing_labels:
        run, checkpoint = teacher.run, teacher.checkpoint.removesuffix(".pt")
        # Its configuration is the one that this command composed; its folder may be a copy.
        session = with_weights(run, run.folder, checkpoint, run.plain)
        from rgbt.evaluation.images import write_pseudo_labels  # few runs have a teacher

        wanted = measurement_of(session, domain.split, domain.teacher_view)
        write_pseudo_labels(session, wanted, folder, threshold=domain.threshold)


def train_run(
    spec: RunSpec, extra_tags: Mapping[str, str] | None = None, upstream_of: str = ""
) -> None:
    """Train a run to its end, or resume it, and print its result.

    Args:
        spec: the run.
        extra_tags: MLflow tags of the run (see `rgbt.runs.naming.describe`).
        upstream_of: name of the run that needs this one, which is announced in one line, as is its
            result; "": the requested run, with all tables.

    Raises:
        InputError: the configuration, the data or the run folder do not fit.
        RunError: the training failed.
    """
    # Everything is built before the folder is made: a wrong value leaves nothing behind.
    setup, description = set_up_training(spec), describe(spec, extra_tags)
    if upstream_of:
        announce_upstream(setup, description.name, upstream_of, spec.folder)
    else:
        announce_training(setup, description.name, spec.folder)
    if rank() > 0:
        Training(setup, description, RunFolder(spec.folder, writes=False), Tracking()).run()
        return
    tracking = spec.tracking.build()
    if spec.fresh and (kept := set_aside(RunFolder(spec.folder))) is not None:
        known = read_description(kept.path)
        if known is not None:
            tracking.refresh(kept, known)
    folder = RunFolder(spec.folder)
    with folder.lock():
        Training(setup, description, folder, tracking).run()
    if upstream_of:
        print_upstream_result(folder, description.name)
    else:
        print_result(spec, folder, tracking, is_point=bool(extra_tags))


class Training(Hooks):
    """Trains one run, from its objects to its result.

    Args:
        setup: the objects of the training.
        description: how trackers show the run.
        folder: of the run; a process that does not write it trains and evaluates its part.
        tracking: gets what is written.
    """

    def __init__(
        self, setup: TrainingSetup, description: Description, folder: RunFolder, tracking: Tracking
    ) -> None:
        self.setup, self.session, self.spec = setup, setup.session, setup.session.spec
        self.description, self.folder, self.tracking = description, folder, tracking
        settings = settings_digest(self.spec.plain)
        self.state = State(seed=self.spec.seed_of("masks"), key=folder.path.name, settings=settings)
        self.selected: list[Counts] = []  # counts of the last evaluation in training

    def run(self) -> None:
        """Train to the last step, evaluate the best checkpoint, write the result."""
        started = time.time()
        fingerprint = self.session.dataset.fingerprint()
        self._claim(fingerprint)
        with self._tracked():
            tags = {**self.description.tags, "rgbt.key": self.folder.path.name}
            self.tracking.start(self.folder, replace(self.description, tags=tags))
            self._train()
            reached = self._evaluate_best()
            state = self.state
            result = {
                "name": self.description.name,
                "key": state.key,
                "dataset": fingerprint,
                "steps": state.step,
                "best_step": state.best_step,
                **({"best_score": state.best_score} if state.best_score >= 0 else {}),
                "seconds_of_last_process": round(time.time() - started, 1),
                "skipped": state.skipped,
                **{kind: without_nan(values) for kind, values in reached.items()},
            }
            self.folder.finish(result)

    def _claim(self, fingerprint: str) -> None:
        """Write what identifies the run; refuse a folder that was started on other images."""
        root = self.session.dataset.root
        now: Marker = {"names": names_key(self.session), "files": fingerprint}
        if self.session.thermal_range is not None:
            now["thermal_range"] = self.session.thermal_range
        before = read_marker(self.folder.path) or now
        if before["names"] != now["names"]:
            raise InputError(
                f"{self.folder.path} was started on other images than those listed in {root}. "
                "Choose another folder of runs (runs_dir=...) or another name of the data set "
                "(dataset.name=...)."
            )
        if before["files"] != now["files"]:
            info(f"files of {root} have changed since this run was started.")
        self.folder.mark(now)
        config = OmegaConf.to_yaml(OmegaConf.create(dict(self.spec.plain)))
        self.folder.write_config(without_passwords(config))

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

    def _train(self) -> None:
        """Train from the last checkpoint, if any, to the last step, and take the best weights."""
        setup, state, settings = self.setup, self.state, self.session.trainer
        trainer = Trainer(
            fabric=setup.fabric,
            settings=settings,
            phases=setup.scheme.phases,
            model=self.session.model,
            others=setup.others,
            optimizers=setup.optimizers,
            schedule=setup.schedule,
            steps_per_epoch=max(1, setup.steps_per_epoch // settings.accumulate),
            folder=self.folder.path,
            hooks=self,
            writes=self.folder.writes,
        )
        if trainer.resume(state):
            info(f"{self.description.name} resumes at step {state.step} ({self.folder.path}).")
        own_code = {"own_code": self.spec.own_code(), "from_step": state.step}
        self.folder.add_provenance({**provenance(), **own_code})
        warn_of_steps(self.folder.path, state.step)
        lines = self.folder.truncate_after(state.step, state.evaluated_step)
        reached = max((line.step for line in lines), default=0)
        if reached > state.step:
            info(f"steps {state.step + 1} to {reached} were not saved and are repeated.")
        with self._naming_memory():
            trainer.fit(self._batches(), state)
        computed_once(lambda: None)  # process 0 has written the best checkpoint
        best = load_best(self.folder.path, state)
        restore_weights(self.session.model, best, self.folder.path / BEST)

    def _naming_memory(self) -> AbstractContextManager[None]:
        """Name the settings of this run with which a step needs less memory."""
        session, sizes = self.session, self.setup.sizes["trained"]
        size, precision = session.loading.batch_size, session.trainer.precision
        network = record_of(session.model, NetworkRecord)
        crop_hw = record_of(session.transform, TransformRecord).crop_hw
        advice = training_advice(session.trainer, size, network, crop_hw)
        what = f"a training step of {size} images of {sizes} in {precision}"
        return naming_memory(session.device, what, advice)

    def _batches(self) -> Iterator[StepData]:
        """Yield batches; unreadable files are noted in the state before a checkpoint is written."""
        accumulate = self.session.trainer.accumulate
        last = self.session.trainer.max_steps * accumulate
        batches = self.setup.batches(range(self.state.step * accumulate, last))
        for batch in batches:
            if batches.skipped:
                self.state.skip(batches.skipped)
            yield batch

    # What happens around a step, in its order (see `Hooks`).

    def log(self, step: int, values: Values) -> None:
        """Append the values of the last steps to the log."""
        self.folder.append(step, "train", values)

    def after_step(self) -> None:
        """Start a store that starts slowly."""
        self.tracking.after_step()

    def evaluate(self, step: int, network: nn.Module) -> float | None:
        """Evaluate the selection split, and return its mIoU; None where there is no such split."""
        split = self.session.selection_split
        if split is None:
            return None
        session = self._session_of(network, step)
        result, self.selected, of_target = evaluate_split(session, split)
        values = scores.summary(result.counts, session.regions.absent) | of_target
        self.folder.append(step, "val", values)
        self.state.skip(result.skipped)
        return values[names.MIOU]

    def keep(self) -> Callable[[Path], None]:
        """Return what writes the counts of the evaluation, which are those of the best weights."""
        session = self._session_of(self.session.model, 0)
        counts = self.selected
        return lambda folder: save_counts(replace(session, folder=folder), counts)

    def show(self) -> None:
        """Send the evaluation to the tracker."""
        self.tracking.update()

    # What follows the last step.

    def _session_of(self, network: nn.Module, step: int) -> Session:
        """Return the session with a network of this run, after a step."""
        path = self.folder.path
        return replace(self.session, model=network, step=step, folder=path, run=path.name)

    def _save(self, counts: Iterable[Counts]) -> None:
        """Save counts in the run folder, in the process that writes."""
        if self.folder.writes:
            save_counts(self._session_of(self.session.model, 0), counts)

    def _evaluate_best(self) -> dict[str, Values]:
        """Evaluate the best checkpoint, write all but the result, and return scores by split."""
        session, state = self._session_of(self.session.model, self.state.best_step), self.state
        pairs = computed_once(lambda: measure_consistency(session, self.folder))
        keep = panel_names(session.dataset, "test")
        result, counts, beside = evaluate_split(session, "test", keep)
        of_other_head, values_of_it = evaluate_other_head(session)
        beside |= values_of_it
        state.skip(result.skipped)
        self._save([*counts, *of_other_head])
        draw_extremes(session, result.counts, writes=self.folder.writes)
        values = scores.summary(result.counts, session.regions.absent) | beside
        table = None
        if "test" in pairs:
            table, of_pairs = pairs["test"]
            values |= of_pairs
        self.folder.append(state.step, "test", values)
        if not self.folder.writes:
            return {}
        self._write_tables(result, beside, table)
        selected = self._selection_scores()
        if selected is None:
            return {"test": values}
        if "val" in pairs:
            selected |= pairs["val"][1]
        return {"val": selected, "test": values}

    def _selection_scores(self) -> Values | None:
        """Return the scores of the best checkpoint on the selection split, if there is one."""
        split = self.session.selection_split
        if split is None:
            return None
        for line in self.folder.lines():
            if line.kind == "val" and line.step == self.state.best_step:
                return line.values
        counts = Counts.load(self.folder.path / counts_name(split))  # the log was cut off
        return scores.summary(counts, self.session.regions.absent)

    def _write_tables(
        self, result: Measured, beside: Values, consistency: ConsistencyTable | None
    ) -> None:
        """Write tables and pictures of the test split; `beside` are its mIoUs in other views."""
        session, name = self.session, self.description.name
        tables = result_tables(result.counts, session.regions, name, self.state.best_step)
        # These become rows of the table: "thermal", "thermal, day", "source head, night".
        mious = dict(tables.classes.subset_mious)
        for key, value in beside.items():
            *words, _ = key.replace("_", " ").split("/")
            mious[", ".join(words)] = value
        classes = replace(tables.classes, subset_mious=mious)
        tables = replace(tables, classes=classes, consistency=consistency)
        self.folder.write_tables(tables)
        if not result.kept:
            info("no image of the panel could be read, so no pictures were drawn.")
            return
        draw_panel(result.kept, session.dataset, self.folder.figure_path("panel"))
        height, width = result.kept[0][1].shape
        draw_region_heat(
            f"{name}: IoU by region, {session.dataset.name} {tables.split}",
            session.regions.map((height, width)),
            tables.regions.region_ious,
            self.folder.figure_path("regions"),
        )


# The measurements of a training.


def evaluate_split(
    session: Session, split: str, keep: Sequence[str] = ()
) -> tuple[Measured, list[Counts], Values]:
    """Evaluate a split, also in the view of the target where that is not the source's.

    Returns the evaluation, the counts of each, and the mIoU in the view of the target by names that
    begin with the view. `keep` names images for pictures.
    """
    result = measure(session, measurement_of(session, split), keep=keep)
    view = None if session.domains.target is None else session.domains.target.view
    if view is None or view == view_of(session):
        return result, [result.counts], {}
    counts = measure(session, measurement_of(session, split, view)).counts
    values = scores.summary(counts, session.regions.absent)
    by_time = (names.subset(time, names.MIOU) for time in (names.DAY, names.NIGHT))
    of_view = {}
    for name in (names.MIOU, *by_time):
        if name in values:
            of_view[names.subset(view, name)] = values[name]
    return result, [result.counts, counts], of_view


def evaluate_other_head(session: Session) -> tuple[list[Counts], Values]:
    """Evaluate the test split by the head that is not selected for the night.

    Returns its counts, and its mIoU at night, named after the head. Nothing in a run without a head
    for the day and another one for the night.
    """
    if session.domains.target_is != "night":
        return [], {}
    head: TestedHead = "target" if session.domains.tested_head == "source" else "source"
    counts = measure(session, measurement_of(session, "test", head=head)).counts
    values = scores.summary(counts, session.regions.absent)
    at_night = names.subset(names.NIGHT, names.MIOU)
    if at_night not in values:
        return [counts], {}
    return [counts], {names.by_head(head, at_night): values[at_night]}


def save_counts(session: Session, counts: Iterable[Counts]) -> None:
    """Save counts where the run of `session` has them."""
    for of_view in counts:
        path = path_of(session, of_view.measurement)
        path.parent.mkdir(exist_ok=True)
        of_view.save(path)


def measure_consistency(
    session: Session, folder: RunFolder
) -> dict[str, tuple[ConsistencyTable, Values]]:
    """Measure TC and CA under "val" and "test", as far as requested, and save counts and pairs."""
    found: dict[str, tuple[ConsistencyTable, Values]] = {}
    if not session.consistency.sets:
        return found
    from rgbt.evaluation.pairs import count as frames
    from rgbt.evaluation.pairs.frames import pairs_of
    from rgbt.tracking.pair_pictures import draw_pairs

    for kind in session.consistency.splits:
        split = session.selection_split if kind == "val" else kind
        if split is None:
            info(f"consistency was not measured on val: {session.dataset.name} has none.")
            continue
        keep = panel_names(session.dataset, split) if kind == "test" else ()
        try:
            wanted = measurement_of(session, split)
            pairs = frames.count_pairs(session, wanted, pairs_of(session, split), keep)
        except InputError as error:
            # The training is done: an error of an extra evaluation must not lose it.
            info(f"{error} Consistency was not measured; see `rgbt consistency`.")
            continue
        save_counts(session, pairs.counts.values())
        table = frames.consistency_table(pairs.counts, session.regions.absent)
        found[kind] = table, frames.consistency_values(table)
        if pairs.kept:
            draw_pairs(pairs.kept, session.dataset, folder.figure_path("pairs"))
    return found
