"""Options that several commands take, each declared once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from rgbt.config.options import Help

AS_TRAINED: Final = "as trained"  # keeps the setting of the trained run

RunsDir = Annotated[Path, Help("folder of runs")]
Trained = Annotated[
    str,
    Help("run folder, config key or MLflow run id; or name model=..., model.weights=FILE, dataset"),
]
Exported = Annotated[Path | None, Help("ONNX file of `rgbt export`, on the CPU; instead of run")]
Split = Annotated[str, Help("split of the data set")]
Checkpoint = Annotated[Literal["best", "last"], Help("best (by validation mIoU) or last")]
Modality = Annotated[str, Help("rgbt, rgb or thermal; default: what the network was designed for")]
Head = Annotated[
    Literal["as trained", "own", "source", "target"],
    Help("head of a network with one head per domain: own, source or target"),
]
CorruptionName = Annotated[
    str,
    Help("a file of conf/corruption with a severity: noise severity=16; of one image: noise:rgb"),
]
Severity = Annotated[str, Help("severity of the corruption")]
BatchNorm = Annotated[
    Literal["as trained", "recomputed", "adabn", "batch"],
    Help(
        "recomputed over batch_norm_splits; adabn: day and night separately; batch: of each batch"
    ),
]
BatchNormSplits = Annotated[str, Help("splits of these statistics; default: the evaluated one")]
RegionsFile = Annotated[
    str, Help("partition of the image, a file of conf/metric: ring5, ring9, vertical5, horizontal5")
]
Trust = Annotated[
    str,
    Help("own modules and folders of code that the run executes, such as my_lab,/code/GMNet"),
]


@dataclass(frozen=True, kw_only=True)
class PredictionFormatOptions:
    """Options of files of predictions."""

    format: Annotated[
        Literal["index", "colour"],
        Help("what is a class: index: the stored numbers; colour: the colours shown"),
    ] = "index"
    palette: Annotated[
        str,
        Help("of coloured files: dataset, or a YAML file with the key palette"),
    ] = "dataset"
    prefix: Annotated[str, Help("start of the file names, such as Pred_")] = ""
    suffix: Annotated[str, Help("end of the file names, such as _pred")] = ""

    @property
    def form(self) -> tuple[Literal["index", "colour"], str, str, str]:
        """Return all of them, as `rgbt.data.predictions.PredictionReader` takes them."""
        return self.format, self.palette, self.prefix, self.suffix


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Options that select a trained network."""

    run: Trained = ""
    exported: Exported = None
    runs_dir: RunsDir = Path("runs")
    checkpoint: Checkpoint = "best"
    trust: Trust = ""
