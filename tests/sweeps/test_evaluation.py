"""Further evaluations of a run: the commands and the paths of their counts."""

from __future__ import annotations

import pytest

from rgbt.config.options import types_of
from rgbt.consistency import Options as OfConsistency
from rgbt.evaluate import Options as OfEvaluate
from sweeps.evaluation import ExtraEvaluation

OPTIONS = {"rgbt.evaluate": OfEvaluate, "rgbt.consistency": OfConsistency}

E = ExtraEvaluation


@pytest.mark.parametrize(
    ("evaluation", "words", "file"),
    [
        (E("thermal", "ring9"), "thermal regions=ring9", "thermal_ring9"),
        (
            E("rgb", "ring9", head="source"),
            "rgb regions=ring9 head=source",
            "rgb_ring9_source-head",
        ),
        (
            E("rgbt", "ring9", corruption="noise", severity=16.0),
            *("rgbt regions=ring9 corruption=noise severity=16", "rgbt_ring9_noise-16"),
        ),
        (
            E("rgb", "ring5", corruption="removed:rgb"),
            *("rgb regions=ring5 corruption=removed:rgb", "rgb_ring5_rgb_removed"),
        ),
        (
            E(batch_norm="adabn", batch_norm_splits=("day", "night")),
            "default regions=as\xa0trained batch_norm=adabn batch_norm_splits=day,night",
            "default_as-trained_norm-adabn-day-night",
        ),
        (
            E(regions="ring5", world="N+", dataset=("dataset.rgb_noise=0.1",)),
            # sha256 of "dataset.rgb_noise=0.1"
            *("default regions=ring5 dataset.rgb_noise=0.1", "default_ring5_world-45f37709"),
        ),
        (
            E("rgb", "ring5", corruption="noise", severity=8.0, details="size"),
            "rgb regions=ring5 corruption=noise severity=8 details=all",
            "rgb_ring5_noise-8-size",
        ),
        *((E(frames=frames), "", frames) for frames in ("aligned", "released", "next")),
    ],
    ids=str,
)
def test_evaluation_has_command_and_file(evaluation: E, words: str, file: str) -> None:
    module, name = "rgbt.evaluate", f"table_{file}"
    arguments = [word.replace("\xa0", " ") for word in f"modality={words}".split(" ")]
    if evaluation.frames is not None:
        module, name = "rgbt.consistency", f"consistency_{file}_test"
        arguments = ["frames=next" if file == "next" else "frames=virtual"]
    assert evaluation.command == (module, *arguments)
    assert (evaluation.path, evaluation.label) == (f"evaluations/{name}.npz", name)
    options = {word.partition("=")[0] for word in arguments if word not in evaluation.dataset}
    assert options <= set(types_of(OPTIONS[module]))
