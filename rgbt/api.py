"""Finished runs in Python: scores, counts and predictions for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.assembly.load_run import CHECKPOINTS, open_run, trusted_settings
from rgbt.assembly.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.config.stored_config import parse_trust, read_settings
from rgbt.data.domains import TestedHead
from rgbt.data.new_images import of_arrays, of_files
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.images import batch_of
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics.names import in_percent
from rgbt.metrics.scores import iou, recall, summary
from rgbt.runs.folder import GROUP, find_run, is_finished, runs_in
from rgbt.runs.result import RunResult
from rgbt.runs.specify import load_spec
from rgbt.terminal import warn
from rgbt.types import Batch, View

if TYPE_CHECKING:
    import pandas as pd

Image = NDArray[Any] | Path | str
"""An image as an array, or the path of its file."""


@dataclass(frozen=True, repr=False)
class Run(RunResult):
    """A run: what its folder holds, and predictions of its network, which is built at first use.

    Attributes:
        overrides: changes of the run's configuration.
        checkpoint: "best" (by validation mIoU) or "last".
        trust: modules that its configuration may name.
    """

    overrides: tuple[str, ...] = ()
    checkpoint: Literal["best", "last"] = "best"
    trust: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<rgbt.Run {self.name or self.key}, {self.folder}>"

    @property
    def name(self) -> str:
        """Name as in MLflow, for example "sigma_div=2 seed=1 · grbm"."""
        return self.description.name

    @property
    def experiment(self) -> str:
        """Name of the experiment, for example "grbm"."""
        return self.tags.get("rgbt.experiment", "")

    @property
    def group(self) -> str:
        """Name that all seeds of one configuration share, for example "grbm sigma_div=2"."""
        return self.tags.get(GROUP, "")

    @property
    def seed(self) -> int | None:
        """Seed of the run; None where the folder does not state it."""
        text = self.tags.get("rgbt.seed", "")
        return int(text) if text else None

    @property
    def dataset(self) -> LabelledDataset:
        """The data set of the run: classes, palette, splits and images."""
        return self._network.dataset

    def scores(self, split: str = "test") -> dict[str, float]:
        """Every score that follows from `counts`, by name (`rgbt.metrics.names`).

        Returns:
            percent, such as "mIoU", "region/1", "class/car", "day/mIoU"; "Var": squared points.
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

        Both images are arrays, or both are paths of files. Files are read by the rules of the run's
        data set, which may cut images and scale thermal values (``dataset.thermal_range``). Thermal
        arrays of uint8 are grey levels as the network gets them (`rgbt.types.Sample.thermal`);
        arrays of other types are values of the camera and treated as files are.

        Args:
            rgb: (H, W, 3) uint8 in the order red, green, blue; or a path.
            thermal: (H, W); or a path.
            modality: "rgbt", "rgb" or "thermal"; None: what the network is made for.
            head: of a network with a head per domain: "own", "source" or "target"; None: as the
                run's configuration says.

        Returns:
            (H, W) uint8, indices of ``run.dataset.classes``.

        Raises:
            InputError: images of other types, shapes or values; a run without checkpoint; a
                modality or head that the network does not have.
        """
        predictor, batch = self._prepare(rgb, thermal, modality, head)
        return cast(NDArray[np.uint8], predictor.classes(batch)[0].cpu().numpy())

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
            (Mask2Former) these are shares of the class scores.
        """
        predictor, batch = self._prepare(rgb, thermal, modality, head)
        return cast(NDArray[np.float32], predictor.probabilities(batch)[0].cpu().numpy())

    @cached_property
    def _network(self) -> Session:
        return open_run(self.folder, self.overrides, self.checkpoint, trust=self.trust)

    def _prepare(
        self, rgb: Image, thermal: Image, modality: View | None, head: TestedHead | None
    ) -> tuple[Predictor, Batch]:
        if head is not None:
            check_choice("head", head, get_args(TestedHead))
        session = self._network
        request = EvaluationRequest(split="", view=modality, head=head)
        predictor = Predictor(session, session.model, request)
        if isinstance(rgb, str | Path) and isinstance(thermal, str | Path):
            files = of_files(session.dataset, Path(rgb), Path(thermal))
            sample = files.read(files.names[0])
        else:
            sample = of_arrays(session.dataset, rgb, thermal)
        return predictor, batch_of(session, sample)


@dataclass(frozen=True)
class Results:
    """The finished runs of a folder, by key; replaced runs are not among them."""

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
            long: one row per run, region and class with the columns "region" (0: the whole image),
                "class", "IoU" and "Acc" (recall), percent; else one per run, as `Run.scores`.

        Returns:
            begins with the columns "key", "name", "experiment", "group", "seed", "dataset", "split"
            and "step" (of the best checkpoint). Scores that a run does not have are NaN.
        """
        import pandas as pd

        found: list[dict[str, Any]] = []
        for run in self.runs:
            try:
                found += _rows(run, split, long=long)
            except InputError as error:
                warn(f"{run.key} is left out: {error}")
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
        run: its folder ("runs/cdeb6e2248f3"), key ("cdeb6e2248f3") or MLflow run id.
        overrides: changes of its configuration, such as "dataset.root=/data/MFNet" or
            "trainer.accelerator=cpu", as of ``rgbt predict``.
        runs_dir: the folder of runs, for keys and ids.
        checkpoint: "best" (by validation mIoU) or "last".
        trust: your own modules that the run was made with, such as "my_lab"; their code is run.

    Raises:
        InputError: no such run, a class in its configuration that is neither part of rgbt nor
            trusted, or overrides that do not fit.
    """
    check_choice("checkpoint", checkpoint, CHECKPOINTS)
    if isinstance(overrides, str):
        raise InputError(f"overrides: expected a list of overrides, got the text '{overrides}'.")
    modules = parse_trust(trust)
    folder = find_run(str(run), Path(runs_dir))
    settings = trusted_settings(folder, modules, overrides)
    load_spec(settings, overrides)  # refused now, and not when it predicts
    return Run(folder, "", tuple(overrides), checkpoint, modules)


def results(runs_dir: str | Path = "runs") -> Results:
    """The finished runs of a folder: ``rgbt.results("runs").to_pandas()[["name", "mIoU"]]``."""
    return Results(tuple(Run(each.path) for each in runs_in(runs_dir) if is_finished(each.path)))


def _rows(run: Run, split: str, *, long: bool) -> list[dict[str, Any]]:
    """The rows of a run in `Results.to_pandas`."""
    counts, node = run.counts(split), read_settings(run.folder / "config.yaml").get("dataset", {})
    dataset = node.get("name") or str(node.get("_target_", "")).rpartition(".")[2].lower()
    texts, step = (run.key, run.name, run.experiment, run.group), run.result.get("best_step")
    identity = dict(zip(COLUMNS, (*texts, run.seed, dataset, split, step), strict=True))
    if not long:
        return [identity | run.scores(split)]
    regions = np.concatenate([counts.whole()[None], counts.by_region()])
    ious, recalls = (100 * score(regions, counts.absent) for score in (iou, recall))
    return [
        identity
        | {"region": region, "class": name, "IoU": ious[region, k], "Acc": recalls[region, k]}
        for region in range(len(regions))
        for k, name in enumerate(counts.classes)
    ]
