"""Further evaluations of a run: what makes them and where their counts lie."""

from __future__ import annotations

from rgbt.config.options import types_of
from rgbt.consistency import Options as OfConsistency
from rgbt.evaluate import Options as OfEvaluate
from sweeps.evaluation import ExtraEvaluation


def test_evaluation_of_single_frames_has_command_and_path() -> None:
    ring = ExtraEvaluation("thermal", "ring9")
    assert ring.command == ("rgbt.evaluate", "modality=thermal", "regions=ring9")
    assert ring.path == "evaluations/table_thermal_ring9.npz"
    assert ring.label == "thermal, ring9"
    assert {word.partition("=")[0] for word in ring.command[1:]} <= set(types_of(OfEvaluate))


def test_evaluation_with_head_has_own_path() -> None:
    day = ExtraEvaluation("rgb", "ring9", head="source")
    assert day.command == ("rgbt.evaluate", "modality=rgb", "regions=ring9", "head=source")
    assert day.path == "evaluations/table_rgb_ring9_source-head.npz"
    assert day.label == "rgb, ring9, source head"
    assert {word.partition("=")[0] for word in day.command[1:]} <= set(types_of(OfEvaluate))
    assert ExtraEvaluation(head="own").path == "evaluations/table_default_as-trained_own-head.npz"
    assert ExtraEvaluation(head="own").command[-1] == "head=own"


def test_failing_images_have_a_file_of_their_own() -> None:
    noisy = ExtraEvaluation("rgbt", "ring9", degradation="noise", severity=16.0)
    words = ("modality=rgbt", "regions=ring9", "degradation=noise", "severity=16")
    assert noisy.command == ("rgbt.evaluate", *words)
    assert noisy.path == "evaluations/table_rgbt_ring9_noise-16.npz"
    assert noisy.label == "rgbt, ring9, noise-16"
    assert {word.partition("=")[0] for word in words} <= set(types_of(OfEvaluate))
    removed = ExtraEvaluation(head="own", degradation="rgb_removed")
    assert removed.command[-2:] == ("head=own", "degradation=rgb_removed")
    assert removed.path == "evaluations/table_default_as-trained_own-head_rgb_removed.npz"
    assert removed.label == "default, as trained, own head, rgb_removed"
    share = ExtraEvaluation(degradation="occluded", severity=0.25)
    assert share.path.endswith("as-trained_occluded-0.25.npz")
    assert share.command[-1] == "severity=0.25"


def test_of_virtual_views_one_call_makes_two_files() -> None:
    aligned, released = ExtraEvaluation(frames="aligned"), ExtraEvaluation(frames="released")
    assert aligned.command == released.command == ("rgbt.consistency", "frames=virtual")
    assert aligned.path == "evaluations/consistency_aligned_test.npz"
    assert released.path == "evaluations/consistency_released_test.npz"
    assert aligned.label == "consistency, aligned"
    assert ExtraEvaluation(frames="next").command == ("rgbt.consistency", "frames=next")
    assert {word.partition("=")[0] for word in aligned.command[1:]} <= set(types_of(OfConsistency))
