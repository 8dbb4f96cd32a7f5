"""Options that several commands take, each declared once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from rgbt.config.options import Help

AS_TRAINED: Final = "as trained"
"""Value of an option: what the run was trained with."""

RunsDir = Annotated[Path, Help("folder of runs")]
Trained = Annotated[
    str,
    Help(
        "run folder, config key or MLflow run id; without one, name a network and its weights: "
        "model=mfnet model.weights=final.pth dataset.root=/data/MFNet (scale=paper)"
    ),
]
Split = Annotated[str, Help("split of the data set")]
Checkpoint = Annotated[Literal["best", "last"], Help("best (by validation mIoU) or last, of a run")]
Modality = Annotated[
    str,
    Help("rgbt, rgb or thermal: what is predicted from; by default what the network is made for"),
]
Head = Annotated[
    Literal["as trained", "own", "source", "target"],
    Help("of a network with a head per domain: own, source or target"),
]
RegionsFile = Annotated[str, Help("a file of conf/metric: ring5, ring9, vertical5, horizontal5")]
Trust = Annotated[
    str, Help("modules of yours that the run was made with: trust=my_lab; their code is run")
]


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Which trained network; what the options of every command that evaluates one begin with."""

    run: Trained = ""
    runs_dir: RunsDir = Path("runs")
    checkpoint: Checkpoint = "best"
    trust: Trust = ""
