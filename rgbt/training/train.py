"""Train one run, evaluate it, and write everything into its run folder.

Of several processes of a run, each trains and evaluates its part; process 0 writes and reports.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

from omegaconf import OmegaConf
from torch import nn

from rgbt.assembly.load_run import with_weights
from rgbt.assembly.session import Session, names_key
from rgbt.assembly.training_setup import TrainingSetup, set_up_training, validate
from rgbt.checks import InputError
from rgbt.data.domains import TestedHead
from rgbt.engine.checkpoint import Checkpoints, State, restore_weights
from rgbt.engine.memory import naming_memory, training_advice
from rgbt.engine.trainer import Loaded, Trainer
from rgbt.evaluation.measure import (
    Measured,
    measure,
    measurement_of,
    panel_names,
    path_of,
)
from rgbt.evaluation.predict import view_of
from rgbt.evaluation.tables import result_tables
from rgbt.metrics import names, scores
from rgbt.metrics.counts import Counts
from rgbt.processes import agreed, alone
from rgbt.requirements import NetworkRecord, TransformRecord, record_of
from rgbt.runs.folder import (
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
from rgbt.terminal import info
from rgbt.tracking.pictures import draw_panel, draw_region_heat
from rgbt.tracking.tracker import Tracking
from rgbt.training.report import (
    announce_training,
    announce_upstream,
    print_result,
    print_upstream_result,
)


class SilentFolder(RunFolder):
    """The run folder for the processes that write nothing."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def _nothing(self, *_: object) -> list[MetricLine]:
        """Write nothing; there are no lines."""
        return []

    write_config = add_provenance = describe = append = finish = mark = _nothing  # type: ignore[assignment]
    truncate_after = lines = _nothing  # type: ignore[assignment]


class Training:
    """The training of one run, from its specification to its result.

    Args:
        spec: the run.
        extra_tags: MLflow tags of the run (see `rgbt.runs.naming.describe`).
        upstream_of: name of the run that needs this one, which is announced in one line, as is its
            result; "": the requested run, with all tables.
    """

    setup: TrainingSetup
    folder: RunFolder
    tracking: Tracking

    def __init__(
        self, spec: RunSpec, extra_tags: Mapping[str, str] | None = None, upstream_of: str = ""
    ) -> None:
        self.spec, self.upstream_of = spec, upstream_of
        self.description = describe(spec, extra_tags)
        self._is_first = True
        self._selected: list[Counts] = []  # counts of the last evaluation in training

    @alone()
    def validate(self) -> None:
        """Build everything once; InputError as of `rgbt.assembly.training_setup.validate`."""
        validate(self.spec)

    @alone()
    def predict_labels(self) -> None:
        """Predict the pseudo-labels that are missing, with the networks of upstream runs."""
        for teacher, domain, folder in self.spec.missing_labels:
            run, checkpoint = teacher.run, teacher.checkpoint.removesuffix(".pt")
            # Its configuration is the one that this command composed; its folder may be a copy.
            session = with_weights(run, run.folder, checkpoint, run.plain)
            from rgbt.evaluation.images import write_pseudo_labels  # few runs have a teacher

            wanted = measurement_of(session, domain.split, domain.teacher_view)
            write_pseudo_labels(session, wanted, folder, threshold=domain.threshold)

    def complete(self) -> None:
        """Train the run to its end, or resume it, and print its result.

        Raises:
            InputError: the configuration, the data or the run folder do not fit.
            RunError: the training failed.
        """
        # Everything is built before the folder is made: a wrong value leaves nothing behind.
        self.setup = set_up_training(self.spec)
        path, name = self.spec.folder, self.description.name
        self._is_first = self.setup.fabric.global_rank == 0
        if self.upstream_of:
            announce_upstream(self.setup, name, self.upstream_of, path)
        else:
            announce_training(self.setup, name, path)
        if not self._is_first:
            self.folder, self.tracking = SilentFolder(path), Tracking()
            self._fill_folder()
            return
        self.tracking = self.spec.tracking.build()
        if self.spec.fresh and (kept := set_aside(RunFolder(path))) is not None:
            known = read_description(kept.path)
            if known is not None:
                self.tracking.refresh(kept, known)
        self.folder = RunFolder(path)
        with self.folder.lock():
            self._fill_folder()
        if self.upstream_of:
            print_upstream_result(self.folder, name)
        else:
            print_result(self.spec, self.folder, self.tracking)

    def _fill_folder(self) -> None:
        """Train to the last step, evaluate the best checkpoint, write the result."""
        started = time.time()
        session, key = self.setup.session, self.folder.path.name
        fingerprint = session.dataset.fingerprint()
        self._claim(fingerprint)
        tags = {**self.description.tags, "rgbt.key": key}
        with self._tracked():
            self.tracking.start(self.folder, replace(self.description, tags=tags))
            settings = settings_digest(self.spec.plain)
            state = State(seed=self.spec.drawn.masks, key=key, settings=settings)
            trainer = self._trainer(state)
            self._resume(trainer, state)
            accumulate = session.trainer.accumulate
            steps = range(state.step * accumulate, session.trainer.max_steps * accumulate)
            with self._naming_memory():
                trainer.fit(self._batches(steps, state), state)
            agreed(None)  # process 0 has written the best checkpoint
            checkpoints = Checkpoints(self.folder.path)
            restore_weights(session.model, checkpoints.load_best(state), checkpoints.best)
            pairs = self._consistency(state) if self._is_first else {}
            selected = self._selection_scores(state)
            reached = {} if selected is None else {"val": selected}
            reached["test"] = self._test(state, *pairs.get("test", (None, {})))
            for kind, (_, values) in pairs.items():
                reached[kind] = reached[kind] | values
            result = {
                "name": self.description.name,
                "key": key,
                "dataset": fingerprint,
                "steps": state.step,
                "best_step": state.best_step,
                **({"best_score": state.best_score} if state.best_score >= 0 else {}),
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

    def _naming_memory(self) -> AbstractContextManager[None]:
        """Name the settings of this run with which a step needs less memory."""
        session, sizes = self.setup.session, self.setup.sizes["trained"]
        size, precision = session.loading.batch_size, session.trainer.precision
        network, crop_hw = (
            record_of(session.model, NetworkRecord),
            record_of(session.transform, TransformRecord).crop_hw,
        )
        advice = training_advice(session.trainer, size, network, crop_hw)
        what = f"a training step of {size} images of {sizes} in {precision}"
        return naming_memory(session.device, what, advice)

    def _claim(self, fingerprint: str) -> None:
        """Write what identifies the run; refuse a folder that was started on other images."""
        root = self.setup.session.dataset.root
        now = {"names": names_key(self.setup.session), "files": fingerprint}
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

    def _resume(self, trainer: Trainer, state: State) -> None:
        """Restore the last checkpoint, if any; report what is repeated."""
        if trainer.resume(state):
            info(f"{self.description.name} resumes at step {state.step} ({self.folder.path}).")
        own_code = {"own_code": self.spec.own_code(), "from_step": state.step}
        self.folder.add_provenance({**provenance(), **own_code})
        warn_of_steps(self.folder.path, state.step)
        lines = self.folder.truncate_after(state.step, state.evaluated_step)
        reached = max((line.step for line in lines), default=0)
        if reached > state.step:
            info(f"steps {state.step + 1} to {reached} were not saved and are repeated.")

    def _trainer(self, state: State) -> Trainer:
        setup, session = self.setup, self.setup.session
        split, settings = session.selection_split, session.trainer

        def validate(step: int) -> float:
            assert split is not None, "called only where there is one"
            network = trainer.weights.network
            result, of_target = self._evaluate(network, step, split, self._selected)
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
            steps_per_epoch=max(1, setup.steps_per_epoch // settings.accumulate),
            folder=self.folder.path,
            record=lambda step, values: self.folder.append(step, "train", values),
            validate=None if split is None else validate,
            keep=lambda: self._save(self._selected),
            committed=self.tracking.update,
            after_step=self.tracking.after_step,
        )
        return trainer

    def _batches(self, steps: range, state: State) -> Iterator[Loaded]:
        """The batches, with unreadable files noted in `state` before a checkpoint is written."""
        batches = self.setup.batches(steps)
        for batch in batches:
            if batches.skipped:
                state.skip(batches.skipped)
            yield batch

    def _evaluate(
        self,
        network: nn.Module,
        step: int,
        split: str,
        counts: list[Counts],
        keep: Sequence[str] = (),
    ) -> tuple[Measured, dict[str, float]]:
        """Evaluate a split, also in the view of the target where that is not the source's.

        `counts` are replaced by those. Returns the evaluation, and the mIoU in the view of the
        target by names that begin with the view.
        """
        session = self._session(network, step)
        result = measure(session, measurement_of(session, split), keep=keep)
        counts[:] = [result.counts]
        view = None if session.domains.target is None else session.domains.target.view
        if view is None or view == view_of(session):
            return result, {}
        found = measure(session, measurement_of(session, split, view)).counts
        counts.append(found)
        values = scores.summary(found, session.regions.absent)
        kept = (names.MIOU, *(names.subset(part, names.MIOU) for part in (names.DAY, names.NIGHT)))
        return result, {names.subset(view, name): values[name] for name in kept if name in values}

    def _session(self, network: nn.Module, step: int) -> Session:
        """The session with a network of this run, after a step."""
        path = self.folder.path
        return replace(self.setup.session, model=network, step=step, folder=path, run=path.name)

    def _save(self, every: Sequence[Counts]) -> None:
        session = self._session(self.setup.session.model, 0)
        for counts in every if self._is_first else ():
            path = path_of(session, counts.measurement)
            path.parent.mkdir(exist_ok=True)
            counts.save(path)

    def _selection_scores(self, state: State) -> dict[str, float] | None:
        """Scores of the best checkpoint on the selection split, if there is one."""
        split = self.setup.session.selection_split
        if split is None:
            return None
        for line in self.folder.lines():
            if line.kind == "val" and line.step == state.best_step:
                return line.values
        counts = Counts.load(self.spec.folder / counts_name(split))  # the log was cut off
        return scores.summary(counts, self.setup.session.regions.absent)

    @alone()
    def _consistency(self, state: State) -> dict[str, tuple[ConsistencyTable, dict[str, float]]]:
        """TC and CA of the best checkpoint under "val" and "test", as far as requested."""
        session = self._session(self.setup.session.model, state.best_step)
        found: dict[str, tuple[ConsistencyTable, dict[str, float]]] = {}
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
            self._save([*pairs.counts.values()])
            table = frames.consistency_table(pairs.counts, session.regions.absent)
            found[kind] = table, frames.consistency_values(table)
            if pairs.kept:
                draw_pairs(pairs.kept, session.dataset, self.folder.figure_path("pairs"))
        return found

    def _test(
        self, state: State, pairs: ConsistencyTable | None, of_pairs: dict[str, float]
    ) -> dict[str, float]:
        """Counts, tables and figures of the best checkpoint on the test split; its scores."""
        session, counts = self.setup.session, list[Counts]()
        keep = panel_names(session.dataset, "test")
        result, beside = self._evaluate(session.model, state.best_step, "test", counts, keep)
        beside |= self._by_other_head(counts, state.best_step)
        state.skip(result.skipped)
        self._save(counts)
        values = scores.summary(result.counts, session.regions.absent) | beside | of_pairs
        self.folder.append(state.step, "test", values)
        if not self._is_first:
            return values
        name = self.description.name
        tables = result_tables(result.counts, session.regions, name, state.best_step)
        # These become rows of the table: "thermal", "thermal, day", "source head, night".
        rows = {", ".join(n.replace("_", " ").split("/")[:-1]): v for n, v in beside.items()}
        classes = replace(tables.classes, subset_mious={**tables.classes.subset_mious, **rows})
        tables = replace(tables, classes=classes, consistency=pairs)
        self.folder.write_tables(tables)
        if not result.kept:
            info("no image of the panel could be read, so no pictures were drawn.")
            return values
        draw_panel(result.kept, session.dataset, self.folder.figure_path("panel"))
        height, width = result.kept[0][1].shape
        draw_region_heat(
            f"{name}: IoU by region, {session.dataset.name} {tables.split}",
            session.regions.map((height, width)),
            tables.regions.region_ious,
            self.folder.figure_path("regions"),
        )
        return values

    def _by_other_head(self, counts: list[Counts], step: int) -> dict[str, float]:
        """The mIoU at night of the head that is not selected for the night, named after the head.

        Nothing in a run without a head for the day and another one for the night. Its counts are
        added to `counts`.
        """
        session = self._session(self.setup.session.model, step)
        if session.domains.target_is != "night":
            return {}
        head: TestedHead = "target" if session.domains.tested_head == "source" else "source"
        found = measure(session, measurement_of(session, "test", head=head)).counts
        counts.append(found)
        values = scores.summary(found, session.regions.absent)
        at_night = names.subset(names.NIGHT, names.MIOU)
        return {names.by_head(head, at_night): values[at_night]} if at_night in values else {}
