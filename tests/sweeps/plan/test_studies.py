"""Tables of the project that no paper prints."""

from __future__ import annotations

import pytest

from sweeps.plan.planner import Planner
from sweeps.plan.request import make_request

MISSING = "missing_image"


def test_missing_image_has_the_runs_of_crm_ablation() -> None:
    """Rows of crm/table3a cost nothing more than two evaluations of each run."""
    planner = Planner()

    def keys(name: str) -> dict[str, str]:
        request = make_request(name, "demo")
        return {
            row.label: planner.specify(request.overrides(row.label, 0)).key
            for row in request.trained_rows
        }

    ablation = keys("crm/table3a")
    assert keys(MISSING) == {
        "Baseline": ablation["Baseline"],
        "Single-view losses": ablation["(1)"],
        "Masks": ablation["(2)"],
        "CRM": ablation["Ours"],
    }
    for point in make_request(MISSING, "demo").points():
        removed = (("corruption=removed:rgb",), ("corruption=removed:thermal",))
        assert point.evaluations == removed


@pytest.mark.slow
@pytest.mark.parametrize("task", ["night", "thermal"])
def test_self_training_is_compared_at_equal_steps_and_start(task: str) -> None:
    """All second stages of one head start from one run, the source alone among them."""
    name = f"self_training_{task}"
    request = make_request(name, "bench")
    planner = Planner()
    specs = {
        row.label: planner.specify(request.overrides(row.label, 0)) for row in request.trained_rows
    }
    first = specs.pop("Source only")
    assert specs.pop("Two heads").upstream
    assert len(specs) == 8
    assert {spec.plain["trainer"]["max_steps"] for spec in specs.values()} == {160}
    for spec in specs.values():
        assert [run.key for run in spec.upstream] == [first.key]
        assert spec.plain["optimizer"] == first.plain["optimizer"]
        assert spec.plain["data"]["batch_size"] == first.plain["data"]["batch_size"]
    schemes = [spec.plain["scheme"]["_target_"].rpartition(".")[2] for spec in specs.values()]
    assert schemes == ["Supervised", "Adversarial", *["SelfTraining"] * 6]
    views = {label: spec.plain["domains"]["target"] for label, spec in specs.items()}
    view = {"night": "rgb", "thermal": "thermal"}[task]
    assert {target["view"] for target in views.values() if target is not None} == {view}
