"""One run from its configuration to its result, and everything it leaves in its folder."""

from __future__ import annotations

import sys
import textwrap
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config import build, flatten, run_key
from rgbt.data.loaders import steps_per_epoch, train_batches
from rgbt.engine.checkpoint import State, load_checkpoint, load_weights
from rgbt.engine.trainer import Trainer
from rgbt.losses.distillation import sdc, sdn
from rgbt.metrics import names, scores
from rgbt.session import Session, evaluate, open_session, result_tables
from rgbt.tracking.folder import RunFolder
from rgbt.tracking.mlflow_store import Tracking
from rgbt.tracking.pictures import Example, Legend, RegionHeat, draw_panel, draw_region_heat
from rgbt.tracking.provenance import provenance
from rgbt.tracking.tables import ResultTables
from rgbt.tracking.terminal import result_view, show

LABEL_WIDTH = 40
"""Characters of a run's name in its tables; the whole name is in MLflow and in run.json."""

NUM_PANELS = 6
"""Images of the qualitative panel: as many by day as by night where the split holds both."""


def train(config: DictConfig, overrides: Sequence[str]) -> None:
    """Run `config` to its end, continuing where an earlier process stopped.

    Args:
        config: composed and checked.
        overrides: as typed, for the run's name.
    """
    folder = RunFolder(Path(config.runs_dir) / run_key(config))
    tracking: Tracking = build(config.tracking)
    name = run_name(config, overrides)
    if folder.result() is not None:
        _say(f"{name} is finished; showing its result. Another seed is another run: seed=1.")
        _track(tracking, folder, config, name)
        tracking.finish()
    else:
        with folder.lock():
            Run(config, folder, tracking, name).complete()
    tables = folder.tables()
    assert tables is not None, "a finished run has its tables"
    show(result_view(ResultTables.from_json(tables), folder.path, tracking.links()))


def run_name(config: DictConfig, overrides: Sequence[str]) -> str:
    """The experiment and what was changed of it, e.g. "grbm sigma_div=2 seed=1"."""
    silent = ("experiment=", "runs_dir=", "out=", "tracking", "dataset.root=", "name=")
    typed = [item.lstrip("+") for item in overrides]
    changed = [item for item in typed if not item.startswith(silent)]
    short = [
        f"{key.rpartition('.')[2]}={value}" for key, _, value in (c.partition("=") for c in changed)
    ]
    return " ".join([config.name, *short])


def _track(tracking: Tracking, folder: RunFolder, config: DictConfig, name: str) -> None:
    tags = {
        "rgbt.key": folder.path.name,
        "rgbt.experiment": config.name,
        "rgbt.group": name.replace(f" seed={config.seed}", ""),
        "rgbt.seed": str(config.seed),
    }
    params = {key: value for key, value in flatten(config).items() if not key.endswith("_target_")}
    tracking.start(folder, name, tags, params)


def _say(text: str) -> None:
    sys.stderr.write(f"rgbt: {text}\n")


@dataclass(frozen=True)
class Run:
    """A run that is not finished: trains, evaluates and fills its folder."""

    config: DictConfig
    folder: RunFolder
    tracking: Tracking
    name: str

    def complete(self) -> None:
        """Train to the last step, evaluate the best checkpoint, write the result."""
        started = time.time()
        session = open_session(self.config)
        state = State(seed=self.config.seed)
        # Everything is built before the folder is begun: a wrong value leaves nothing behind.
        trainer = self._trainer(session, state)
        self._claim(session)
        _track(self.tracking, self.folder, self.config, self.name)
        try:
            self._train(session, trainer, state)
            self._test(session, state)
            self._finish(session, state, time.time() - started)
        finally:
            # A run that stops on an error is shown as failed, not as running for ever.
            self.tracking.finish()

    def _finish(self, session: Session, state: State, seconds: float) -> None:
        self.folder.finish(
            {
                "name": self.name,
                "key": self.folder.path.name,
                "dataset": session.dataset.fingerprint(),
                "steps": state.step,
                "best_step": state.best_step,
                "best_score": state.best_score,
                "seconds": round(seconds, 1),
                "skipped": sorted(set(state.skipped)),
            }
        )

    def _claim(self, session: Session) -> None:
        """Write what identifies the run; refuse a folder that was begun on other data."""
        fingerprint = session.dataset.fingerprint()
        marker = self.folder.path / "dataset.txt"
        if marker.exists() and marker.read_text() != fingerprint:
            raise InputError(
                f"{self.folder.path} was trained on other files than those in "
                f"{session.dataset.root}; give the data set another name (dataset.name=...) or the "
                "runs another folder (runs_dir=...)."
            )
        marker.write_text(fingerprint)
        self.folder.write_config(OmegaConf.to_yaml(self.config, resolve=True))
        self.folder.add_provenance(provenance())

    def _train(self, session: Session, trainer: Trainer, state: State) -> None:
        if trainer.resume(state):
            _say(f"{self.name} continues at step {state.step} ({self.folder.path}).")
        elif session.trainer.init_from is not None:
            source = Path(session.trainer.init_from)
            source = source / "best.pt" if source.is_dir() else source
            load_weights(session.model, load_checkpoint(source)["model"], source)
        self.folder.truncate_after(state.step)
        accumulate = session.trainer.accumulate
        steps = range(state.step * accumulate, session.trainer.max_steps * accumulate)
        batches = train_batches(
            session.dataset, "train", session.transform, session.loading, state.seed, steps
        )
        trainer.fit(batches, state)
        state.skipped.extend(batches.skipped)

    def _trainer(self, session: Session, state: State) -> Trainer:
        config = self.config
        builder = build(config.optimizer)
        model, optimizer = session.fabric.setup(session.model, builder(session.model))
        scheme = build(
            config.scheme,
            model=model,
            loss=build(config.loss),
            masker=build(config.masker),
            sdc=sdc,
            sdn=sdn,
        )
        per_epoch = steps_per_epoch(session.dataset, session.loading)

        split = session.trainer.selection_split

        def validate(step: int) -> float:
            found = evaluate(session, model, split)
            values = scores.summary(found.counts, session.regions.absent)
            self.folder.append(step, "val", values)
            state.skipped.extend(found.skipped)
            if values[names.MIOU] > state.best_score:
                found.counts.save(self.folder.counts_path(split))
            self.tracking.update()
            return values[names.MIOU]

        return Trainer(
            fabric=session.fabric,
            settings=session.trainer,
            scheme=scheme,
            model=model,
            optimizers={"main": optimizer},
            schedule=build(config.schedule),
            steps_per_epoch=max(1, per_epoch // session.trainer.accumulate),
            folder=self.folder.path,
            record=lambda step, values: self.folder.append(step, "train", values),
            validate=validate,
        )

    def _test(self, session: Session, state: State) -> None:
        """Counts, tables and figures of the best checkpoint on the test split."""
        best = self.folder.path / "best.pt"
        load_weights(session.model, load_checkpoint(best)["model"], best)
        shown = panel_names(session)
        found = evaluate(session, session.model, "test", keep=shown)
        state.skipped.extend(found.skipped)
        found.counts.save(self.folder.counts_path("test"))
        values = scores.summary(found.counts, session.regions.absent)
        self.folder.append(state.step, "test", values)
        label = textwrap.shorten(self.name, LABEL_WIDTH, placeholder=" ...")
        tables = result_tables(found.counts, session.regions, label, state.best_step)
        self.folder.write_tables(tables.to_json())
        self._draw(session, tables, found.kept)

    def _draw(self, session: Session, tables: ResultTables, kept: Sequence[Example]) -> None:
        palette = np.array(session.dataset.palette, np.uint8)
        legend = Legend(session.dataset.classes, palette)
        draw_panel(kept, legend, self.folder.figure_path("panel"))
        heat = RegionHeat(
            title=f"{self.name}: IoU by region, {session.dataset.name} {tables.split}",
            region_map=session.regions.map(kept[0].label.shape).astype(np.int64),
            ious=tables.regions.region_ious,
        )
        draw_region_heat(heat, self.folder.figure_path("regions"))


def panel_names(session: Session) -> tuple[str, ...]:
    """The first images of the test split, half by day and half by night where it holds both."""
    test = session.dataset.names("test")
    night = [name for name in test if session.dataset.is_night(name)]
    day = [name for name in test if not session.dataset.is_night(name)]
    half = NUM_PANELS // 2
    num_day = max(half, NUM_PANELS - len(night))
    return tuple(day[:num_day] + night[: NUM_PANELS - min(num_day, len(day))])
