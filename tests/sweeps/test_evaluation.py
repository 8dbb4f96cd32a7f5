"""Further evaluations of a run: the commands and the paths of their counts."""

from __future__ import annotations

import pytest

from rgbt.config.options import types_of
from rgbt.consistency import Options as OfConsistency
from rgbt.evaluate import Options as OfEvaluate
from sweeps.evaluation import ExtraEvaluation

OPTIONS = {"rgbt.evaluate": OfEvaluate, "rgbt.consistency": OfConsistency}


E = ExtraEvaluation
OF = "rgbt.evaluate modality="


@pytest.mark.parametrize(
    ("evaluation", "command", "file", "label"),
    [
        (E("thermal", "ring9"), f"{OF}thermal regions=ring9", "thermal_ring9", "thermal, ring9"),
        (
            E("rgb", "ring9", head="source"),
            *(f"{OF}rgb regions=ring9 head=source", "rgb_ring9_source-head"),
            "rgb, ring9, source head",
        ),
        (
            E("rgbt", "ring9", corruption="noise", severity=16.0),
            *(f"{OF}rgbt regions=ring9 corruption=noise severity=16", "rgbt_ring9_noise-16"),
            "rgbt, ring9, noise-16",
        ),
        (
            E("rgb", "ring5", head="own", corruption="removed:rgb"),
            f"{OF}rgb regions=ring5 head=own corruption=removed:rgb",
            *("rgb_ring5_own-head_rgb_removed", "rgb, ring5, own head, rgb_removed"),
        ),
        (
            E(batch_norm="adabn", batch_norm_splits=("day", "night")),
            f"{OF}default regions=as\xa0trained batch_norm=adabn batch_norm_splits=day,night",
            "default_as-trained_norm-adabn-day-night",
            "default, as trained, norm-adabn-day-night",
        ),
        (
            E(regions="ring5", world="N+", dataset=("dataset.rgb_noise=0.1",)),
            f"{OF}default regions=ring5 dataset.rgb_noise=0.1",
            # sha256 of "dataset.rgb_noise=0.1"
            *("default_ring5_world-45f37709", "default, ring5, world N+"),
        ),
        (
            E("rgb", "ring5", details="boundary"),
            f"{OF}rgb regions=ring5 details=boundary,calibration",
            *("rgb_ring5-boundary", "rgb, ring5, boundary"),
        ),
        (
            E("rgb", "ring5", corruption="noise", severity=8.0, details="size"),
            f"{OF}rgb regions=ring5 corruption=noise severity=8 details=all",
            *("rgb_ring5_noise-8-size", "rgb, ring5, noise-8, size"),
        ),
        *(
            (E(frames=frames), f"rgbt.consistency frames={word}", "", f"consistency, {frames}")
            for frames, word in (("aligned", "virtual"), ("released", "virtual"), ("next", "next"))
        ),
    ],
    ids=str,
)
def test_evaluation_has_command_file_and_label(
    evaluation: ExtraEvaluation, command: str, file: str, label: str
) -> None:
    module, *words = (word.replace("\xa0", " ") for word in command.split(" "))
    assert evaluation.command == (module, *words)
    name = f"table_{file}" if file else f"consistency_{evaluation.frames}_test"
    assert (evaluation.path, evaluation.label) == (f"evaluations/{name}.npz", label)
    options = {word.partition("=")[0] for word in words if word not in evaluation.dataset}
    assert options <= set(types_of(OPTIONS[module]))
