"""Finished runs in Python: scores, counts and predictions for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.assembly.load_run import CHECKPOINTS, open_run, trusted_settings
from rgbt.assembly.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.config.stored_config import parse_trust
from rgbt.data.domains import TestedHead
from rgbt.data.new_images import of_arrays, of_files
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.images import batch_of
from rgbt.evaluation.predict import Predictor
from rgbt.metrics.names import in_percent
from rgbt.metrics.scores import summary
from rgbt.runs.folder import EXPERIMENT, GROUP, SEED, find_run
from rgbt.runs.result import RunResult
from rgbt.runs.specify import load_spec
from rgbt.types import Batch, View

# An image as an array, or the path of its file.
Image = NDArray[Any] | Path | str


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
        """Return the name as in MLflow, for example "σ 2 · s1 · grbm"."""
        return self.description.name

    @property
    def experiment(self) -> str:
        """Return the name of the experiment, for example "grbm"."""
        return self.tags.get(EXPERIMENT, "")

    @property
    def group(self) -> str:
        """Return the name that all seeds of a configuration share, such as "grbm sigma_div=2"."""
        return self.tags.get(GROUP, "")

    @property
    def seed(self) -> int | None:
        """Return the seed of the run; None where the folder does not state it."""
        text = self.tags.get(SEED, "")
        return int(text) if text else None

    @property
    def dataset(self) -> LabelledDataset:
        """Return the data set of the run: classes, palette, splits and images."""
        return self._network.dataset

    def scores(self, split: str = "test") -> dict[str, float]:
        """Compute every score that follows from `counts`, by name (`rgbt.metrics.names`).

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
        """Predict the class of every pixel of one image pair.

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
        """Predict the probability of every class at every pixel; arguments are those of `predict`.

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
        predictor = Predictor(session, modality, head)
        if isinstance(rgb, str | Path) and isinstance(thermal, str | Path):
            files = of_files(session.dataset, Path(rgb), Path(thermal))
            sample = files.read(files.names[0])
        else:
            sample = of_arrays(session.dataset, rgb, thermal)
        return predictor, batch_of(session, sample)


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
