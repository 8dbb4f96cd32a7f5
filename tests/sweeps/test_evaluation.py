"""Further evaluations of a run: the commands and the paths of their counts."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.config.options import types_of
from rgbt.consistency import Options as OfConsistency
from rgbt.evaluate import Options as OfEvaluate
from rgbt.evaluation.segmentation import details_path as written_beside
from sweeps.evaluation import ExtraEvaluation

OPTIONS = {"rgbt.evaluate": OfEvaluate, "rgbt.consistency": OfConsistency}


@pytest.mark.parametrize(
    ("evaluation", "command", "file", "label"),
    [
        (
            ExtraEvaluation("thermal", "ring9"),
            "rgbt.evaluate modality=thermal regions=ring9",
            "table_thermal_ring9.npz",
            "thermal, ring9",
        ),
        (
            ExtraEvaluation("rgb", "ring9", head="source"),
            "rgbt.evaluate modality=rgb regions=ring9 head=source",
            "table_rgb_ring9_source-head.npz",
            "rgb, ring9, source head",
        ),
        (
            ExtraEvaluation("rgbt", "ring9", corruption="noise", severity=16.0),
            "rgbt.evaluate modality=rgbt regions=ring9 corruption=noise severity=16",
            "table_rgbt_ring9_noise-16.npz",
            "rgbt, ring9, noise-16",
        ),
        (
            ExtraEvaluation("rgb", "ring5", head="own", corruption="removed:rgb"),
            "rgbt.evaluate modality=rgb regions=ring5 head=own corruption=removed:rgb",
            "table_rgb_ring5_own-head_rgb_removed.npz",
            "rgb, ring5, own head, rgb_removed",
        ),
        (
            ExtraEvaluation(batch_norm="adabn", batch_norm_splits=("train_day", "train_night")),
            "rgbt.evaluate modality=default regions=as\xa0trained batch_norm=adabn "
            "batch_norm_splits=train_day,train_night",
            "table_default_as-trained_norm-adabn-train_day-train_night.npz",
            "default, as trained, norm-adabn-train_day-train_night",
        ),
        (
            ExtraEvaluation(regions="ring5", world="N+", dataset=("dataset.rgb_noise=0.1",)),
            "rgbt.evaluate modality=default regions=ring5 dataset.rgb_noise=0.1",
            # sha256 of "dataset.rgb_noise=0.1"
            "table_default_ring5_world-45f37709.npz",
            "default, ring5, world N+",
        ),
        (
            ExtraEvaluation("rgb", "ring5", details="boundary"),
            "rgbt.evaluate modality=rgb regions=ring5 details=boundary,calibration",
            "table_rgb_ring5-boundary.npz",
            "rgb, ring5, boundary",
        ),
        (
            ExtraEvaluation("rgb", "ring5", corruption="noise", severity=8.0, details="size"),
            "rgbt.evaluate modality=rgb regions=ring5 corruption=noise severity=8 details=all",
            "table_rgb_ring5_noise-8-size.npz",
            "rgb, ring5, noise-8, size",
        ),
        (
            ExtraEvaluation(frames="aligned"),
            "rgbt.consistency frames=virtual",
            "consistency_aligned_test.npz",
            "consistency, aligned",
        ),
        (
            ExtraEvaluation(frames="released"),
            "rgbt.consistency frames=virtual",
            "consistency_released_test.npz",
            "consistency, released",
        ),
        (
            ExtraEvaluation(frames="next"),
            "rgbt.consistency frames=next",
            "consistency_next_test.npz",
            "consistency, next",
        ),
    ],
    ids=str,
)
def test_evaluation_has_command_file_and_label(
    evaluation: ExtraEvaluation, command: str, file: str, label: str
) -> None:
    module, *words = (word.replace("\xa0", " ") for word in command.split(" "))
    assert evaluation.command == (module, *words)
    assert (evaluation.path, evaluation.label) == (f"evaluations/{file}", label)
    options = {word.partition("=")[0] for word in words if word not in evaluation.dataset}
    assert options <= set(types_of(OPTIONS[module]))


def test_details_are_written_beside_the_file_that_the_command_writes() -> None:
    details = ExtraEvaluation(details="boundary")
    assert details.out == "evaluations/table_default_as-trained.npz" == ExtraEvaluation().path
    out, path = Path(details.out), Path(details.path)
    assert path == written_beside(out, "boundary")
    for plain in (ExtraEvaluation("rgb"), ExtraEvaluation(frames="next")):
        assert plain.out == plain.path
