"""Finished runs in Python: scores, counts and predictions for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.build.load_run import CHECKPOINTS, TrainedNetwork, open_run, trusted_settings
from rgbt.checks import InputError, check_choice
from rgbt.config.stored_config import parse_trust, read_settings
from rgbt.data.domains import TestedHead
from rgbt.data.to_predict import of_arrays, of_files
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.images import batch_of
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics.counts import Counts
from rgbt.metrics.names import in_percent
from rgbt.metrics.scores import iou, recall, summary
from rgbt.spec.load_spec import load_spec
from rgbt.spec.naming import group_of
from rgbt.tracking.run_folder import find_run, runs_in
from rgbt.tracking.run_result import RunResult
from rgbt.tracking.terminal import warn
from rgbt.types import Batch, Sample, View

if TYPE_CHECKING:
    import pandas as pd

Image = NDArray[Any] | Path | str
"""An image as an array, or the path of its file."""


@dataclass(frozen=True, repr=False)
class Run:
    """One run: what its folder holds, and predictions of its network.

    The network and the data set are built at the first use of `dataset`, `predict` or
    `probabilities`; everything else only reads files. Use `load_run` to get one.

    Attributes:
        files: the run folder, read file by file.
        overrides: changes of the run's configuration.
        checkpoint: "best" (by validation mIoU) or "last".
        trust: modules that its configuration may name.
    """

    files: RunResult
    overrides: tuple[str, ...] = ()
    checkpoint: Literal["best", "last"] = "best"
    trust: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<rgbt.Run {self.name or self.key}, {self.folder}>"

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.files.folder

    @property
    def key(self) -> str:
        """Key of the run, the name of its folder."""
        return self.files.key

    @property
    def name(self) -> str:
        """Name as in MLflow, for example "sigma_div=2 seed=1 · grbm"."""
        return self.files.description.name

    @property
    def experiment(self) -> str:
        """Name of the experiment, for example "grbm"."""
        return self.files.tags.get("rgbt.experiment", "")

    @property
    def group(self) -> str:
        """Name that all seeds of one configuration share, for example "grbm sigma_div=2"."""
        description = self.files.description
        return group_of(description.tags, description.params)

    @property
    def seed(self) -> int | None:
        """Seed of the run; None where the folder does not state it."""
        text = self.files.tags.get("rgbt.seed", "")
        return int(text) if text else None

    @property
    def dataset(self) -> LabelledDataset:
        """The data set of the run: classes, palette, splits and images."""
        return self._network.session.dataset

    def counts(self, split: str = "test") -> Counts:
        """The stored confusion counts of a split, per image and region.

        Args:
            split: "test" and the split that chose the checkpoint (usually "val") are always there;
                ``rgbt evaluate run=... split=... out=RUN_FOLDER/counts_SPLIT.npz`` adds others.

        Raises:
            InputError: the run has no counts of the split; the message says how to make them.
        """
        return self.files.counts_of(split)

    def scores(self, split: str = "test") -> dict[str, float]:
        """Every score that follows from `counts`, by name (`rgbt.metrics.names`).

        Returns:
            percent by name, such as "mIoU", "region/1", "class/car" and "day/mIoU"; "Var" is in
            squared percent points.

        Raises:
            InputError: as `counts`.
        """
        counts = self.counts(split)
        values = summary(counts, counts.absent)
        return {name: in_percent(name, value) for name, value in values.items()}

    def predict(
        self,
        rgb: Image,
        thermal: Image,
        *,
        modality: View | None = None,
        head: TestedHead | None = None,
    ) -> NDArray[np.uint8]:
        """The class of every pixel of one image pair.

        Both images are arrays, or both are paths of files. Files are read as ``rgbt predict``
        reads them: by the rules of the run's data set, which may cut images and scale thermal
        values (``dataset.thermal_range``). Thermal arrays of uint8 are grey levels as the network
        gets them (like `rgbt.types.Sample.thermal`); arrays of other types are values of the
        camera and treated as files are.

        Args:
            rgb: (H, W, 3) uint8 in the order red, green, blue; or a path.
            thermal: (H, W); or a path.
            modality: "rgbt", "rgb" or "thermal": what is predicted from; None: what the network is
                made for.
            head: of a network with a head per domain: "own", "source" or "target"; None: as the
                run's configuration says.

        Returns:
            (H, W) uint8, indices of ``run.dataset.classes``; smaller than the file where the data
            set cuts its images.

        Raises:
            InputError: images of other types, shapes or values; a run without checkpoint; a
                modality or head that the network does not have.
        """
        predictor, batch = self._prepare(rgb, thermal, modality, head)
        classes: NDArray[np.uint8] = predictor.classes(batch)[0].cpu().numpy()
        return classes

    def probabilities(
        self,
        rgb: Image,
        thermal: Image,
        *,
        modality: View | None = None,
        head: TestedHead | None = None,
    ) -> NDArray[np.float32]:
        """The probability of every class at every pixel; arguments and errors as of `predict`.

        Returns:
            (K, H, W) float32, sums over classes are 1. Of networks that predict masks
            (Mask2Former) these are shares of the class scores: see
            `rgbt.engine.evaluate.probabilities`.
        """
        predictor, batch = self._prepare(rgb, thermal, modality, head)
        shares: NDArray[np.float32] = predictor.probabilities(batch)[0].cpu().numpy()
        return shares

    @cached_property
    def _network(self) -> TrainedNetwork:
        return open_run(self.folder, self.overrides, self.checkpoint, trust=self.trust)

    def _prepare(
        self, rgb: Image, thermal: Image, modality: View | None, head: TestedHead | None
    ) -> tuple[Predictor, Batch]:
        if head is not None:
            check_choice("head", head, get_args(TestedHead))
        session = self._network.session
        request = EvaluationRequest(split="", view=modality, head=head)
        predictor = Predictor(session, session.model, request)
        return predictor, batch_of(session, _sample(session.dataset, rgb, thermal))


@dataclass(frozen=True)
class Results:
    """The finished runs of a folder, in the order of their keys; replaced runs are not among them.

    Attributes:
        runs: one `Run` each; a loop over the results is one over them.
    """

    runs: tuple[Run, ...]

    def __iter__(self) -> Iterator[Run]:
        return iter(self.runs)

    def __len__(self) -> int:
        return len(self.runs)

    def to_pandas(self, split: str = "test", *, long: bool = False) -> pd.DataFrame:
        """Scores of all runs as a table, computed from stored counts; no network is built.

        A run that has no counts of the split, or damaged files, is left out with a warning.

        Args:
            split: of the counts.
            long: False: one row per run with the columns of `Run.scores`. True: one row per run,
                region and class with the columns "region" (0: the whole image), "class", "IoU" and
                "Acc" (recall), percent.

        Returns:
            begins with the columns "key", "name", "experiment", "group", "seed", "dataset", "split"
            and "step" (of the best checkpoint). Scores that a run does not have are NaN.
        """
        import pandas as pd

        rows = _by_region_and_class if long else _of_run
        found = [row for run in self.runs for row in _readable(run, split, rows)]
        return pd.DataFrame(found, columns=None if found else COLUMNS)


COLUMNS = ("key", "name", "experiment", "group", "seed", "dataset", "split", "step")


def load_run(
    run: str | Path,
    overrides: Sequence[str] = (),
    *,
    runs_dir: str | Path = "runs",
    checkpoint: Literal["best", "last"] = "best",
    trust: str = "",
) -> Run:
    """Open a run that was trained with ``rgbt run``.

    Args:
        run: its folder ("runs/a281d3f80222"), key ("a281d3f80222") or MLflow run id.
        overrides: changes of its configuration, such as "dataset.root=/data/MFNet" or
            "trainer.accelerator=cpu", as of ``rgbt predict``.
        runs_dir: the folder of runs, for keys and ids.
        checkpoint: "best" (by validation mIoU) or "last".
        trust: your own modules that the run was made with, such as "my_lab"; their code is run.

    Returns:
        the run; its network is built at the first prediction.

    Raises:
        InputError: no such run, a class in its configuration that is neither part of rgbt nor
            trusted, or overrides that do not fit.

    Examples:
        >>> run = rgbt.load_run("runs/a281d3f80222")
        >>> round(run.scores()["mIoU"], 2)
        48.75
    """
    check_choice("checkpoint", checkpoint, CHECKPOINTS)
    if isinstance(overrides, str):
        raise InputError(
            f"overrides: expected a list of overrides, got the text '{overrides}'; put it in "
            "brackets."
        )
    modules = parse_trust(trust)
    folder = find_run(str(run), Path(runs_dir))
    settings = trusted_settings(folder, modules, overrides)
    load_spec(settings, overrides)  # refused now, and not when it predicts
    return Run(RunResult(folder), tuple(overrides), checkpoint, modules)


def results(runs_dir: str | Path = "runs") -> Results:
    """The finished runs of a folder.

    Raises:
        InputError: there is no such folder.

    Examples:
        >>> rgbt.results("runs").to_pandas()[["name", "mIoU", "Var"]]
    """
    stored = [RunResult(run.path) for run in runs_in(runs_dir)]
    return Results(tuple(Run(run) for run in stored if (run.folder / "result.json").is_file()))


def _sample(dataset: LabelledDataset, rgb: Image, thermal: Image) -> Sample:
    if isinstance(rgb, str | Path) and isinstance(thermal, str | Path):
        files = of_files(dataset, Path(rgb), Path(thermal))
        return files.read(files.names[0])
    return of_arrays(dataset, rgb, thermal)


Row = dict[str, Any]


def _readable(run: Run, split: str, rows: Callable[[Run, str], list[Row]]) -> list[Row]:
    try:
        return rows(run, split)
    except InputError as error:
        warn(f"{run.key} is left out: {error}")
        return []


def _of_run(run: Run, split: str) -> list[Row]:
    return [_identity(run, split) | run.scores(split)]


def _by_region_and_class(run: Run, split: str) -> list[Row]:
    counts, identity = run.counts(split), _identity(run, split)
    regions = np.concatenate([counts.whole()[None], counts.by_region()])
    ious, recalls = (100 * score(regions, counts.absent) for score in (iou, recall))
    return [
        identity
        | {"region": region, "class": name, "IoU": ious[region, k], "Acc": recalls[region, k]}
        for region in range(len(regions))
        for k, name in enumerate(counts.classes)
    ]


def _identity(run: Run, split: str) -> Row:
    node = read_settings(run.folder / "config.yaml").get("dataset", {})
    dataset = node.get("name") or str(node.get("_target_", "")).rpartition(".")[2].lower()
    texts = (run.key, run.name, run.experiment, run.group)
    step = run.files.result.get("best_step")
    return dict(zip(COLUMNS, (*texts, run.seed, dataset, split, step), strict=True))
