"""Options that several commands take, each declared once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from rgbt.config.options import Help

AS_TRAINED: Final = "as trained"
"""Value of an option that keeps the setting of the trained run."""

RunsDir = Annotated[Path, Help("folder of runs")]
Trained = Annotated[
    str,
    Help(
        "run folder, config key or MLflow run id. Without a run, name a network and its weights: "
        "model=mfnet model.weights=final.pth dataset.root=/data/MFNet (implies scale=paper)"
    ),
]
Exported = Annotated[
    Path | None,
    Help("ONNX file of `rgbt export`, which onnxruntime computes on the CPU; instead of run"),
]
Split = Annotated[str, Help("split of the data set")]
Checkpoint = Annotated[
    Literal["best", "last"], Help("checkpoint of the run: best (by validation mIoU) or last")
]
Modality = Annotated[
    str,
    Help(
        "input images of the network: rgbt, rgb or thermal; by default those that it was designed "
        "for"
    ),
]
Head = Annotated[
    Literal["as trained", "own", "source", "target"],
    Help("head of a network with one head per domain: own, source or target"),
]
CorruptionName = Annotated[
    str,
    Help(
        "corruption of the images, a file of conf/corruption with a severity: "
        "corruption=noise severity=16. Of one image only: corruption=noise:rgb or "
        "removed:thermal. `rgbt robustness` measures all corruptions"
    ),
]
Severity = Annotated[str, Help("severity of the corruption")]
BatchNorm = Annotated[
    Literal["as trained", "recomputed", "adabn", "batch"],
    Help(
        "statistics of batch normalisation: recomputed: over all images of batch_norm_splits; "
        "adabn: the same for day and night separately; batch: those of each batch. No label is "
        "read for them"
    ),
]
BatchNormSplits = Annotated[
    str,
    Help(
        "splits whose images give these statistics, such as train_day,train_night; default: the "
        "evaluated split"
    ),
]
RegionsFile = Annotated[
    str, Help("partition of the image, a file of conf/metric: ring5, ring9, vertical5, horizontal5")
]
Trust = Annotated[
    str,
    Help(
        "your own Python modules, and folders of other authors' code, that the run uses, such as "
        "trust=my_lab,/code/GMNet; their code is executed"
    ),
]


@dataclass(frozen=True, kw_only=True)
class PredictionFormatOptions:
    """Options that describe files of predictions, common to all commands that read them."""

    format: Annotated[
        Literal["auto", "index", "colour"],
        Help(
            "format of the predictions: index: the stored numbers; colour: the colours shown; "
            "auto: by the files"
        ),
    ] = "auto"
    palette: Annotated[
        str,
        Help(
            "palette of coloured predictions: auto: the known one that fits; dataset: "
            "dataset.palette; a name such as voc; a YAML file with the key palette. -bgr after a "
            "name exchanges red and blue"
        ),
    ] = "auto"
    prefix: Annotated[
        str, Help("beginning of the file names of predictions, such as Pred_; default: as found")
    ] = ""
    suffix: Annotated[
        str, Help("end of the file names of predictions, such as _pred; default: as found")
    ] = ""


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Options that select a trained network, common to all commands that evaluate one."""

    run: Trained = ""
    exported: Exported = None
    runs_dir: RunsDir = Path("runs")
    checkpoint: Checkpoint = "best"
    trust: Trust = ""
