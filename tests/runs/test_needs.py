"""What a run needs before it starts: bytes of its checkpoints, memory of a step, missing files."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from torch import nn

from rgbt.requirements import NetworkRecord
from rgbt.runs.needs import MEMORY, checkpoint_bytes, free_bytes, in_gb, lacking, step_gb
from sweeps.plan.planner import specify_run
from tests.benchmarks import bench_memory
from tests.commands import DAYS_AND_NIGHTS, Trained, short, words_of

ROOT = Path(__file__).resolve().parents[2]
PAPER = ("+experiment=crm", "scale=paper")


@pytest.mark.parametrize(
    "words",
    [
        ("+experiment=crm",),
        ("+experiment=crm", "trainer.averaging=ema"),
        ("+experiment=sh_adversarial", "model.weights=null", *DAYS_AND_NIGHTS),
        ("+experiment=self_training_night", "model.weights=null", *DAYS_AND_NIGHTS),
    ],
    ids=["AdamW", "averaged", "discriminator", "teacher"],
)
def test_bytes_are_those_of_the_files(
    words: tuple[str, ...], trained: Trained, data: Path, tmp_path: Path
) -> None:
    """Names, schedule and zip archive of small networks take up to 7 %."""
    folder = trained(*words, *short(2))
    run = specify_run(words_of(data, tmp_path, *words, *short(2)))
    stored = sum((folder / name).stat().st_size for name in ("last.pt", "best.pt"))
    expected = checkpoint_bytes(run)
    assert expected is not None
    assert expected < stored < 1.07 * expected


def test_bytes_of_the_network_of_crm() -> None:
    """Swin-S has 117.56 M parameters: two copies of the weights, two moments, of 4 bytes each."""
    size = checkpoint_bytes(specify_run(PAPER, checked=False))
    assert size == pytest.approx(4 * 4 * 117.56e6, rel=1e-3)


@pytest.mark.parametrize("weights", ["enet", "median_frequency", "inverse"])
def test_computed_class_weights_do_not_change_the_bytes(weights: str) -> None:
    sizes = []
    for words in ((), (f"loss.class_weights={weights}",)):
        sizes.append(checkpoint_bytes(specify_run(("+experiment=cmx", *words), checked=False)))
    assert sizes[0] == sizes[1]
    assert sizes[0] > 0


class OneLayer(nn.Module):
    """A user's network: it states what NetworkRecord asks for and has no further attribute."""

    record = NetworkRecord(views=("rgbt",))

    def __init__(self, *, num_classes: int, inputs: nn.Module) -> None:
        super().__init__()
        self.classify = nn.Conv2d(4, num_classes, 1, bias=False)


@pytest.mark.parametrize("weights", ["null", "enet"])
def test_bytes_of_a_network_that_has_only_its_record(
    weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "model").mkdir()
    text = f"""
defaults: [inputs: unit, _self_]
_target_: {__name__}.OneLayer
num_classes: 7
"""
    (tmp_path / "model" / "one_layer.yaml").write_text(text)
    monkeypatch.setenv("RGBT_CONF", str(tmp_path))
    words = ("+experiment=mfnet", "model=one_layer", f"loss.class_weights={weights}")
    run = specify_run((*words, "optimizer=adamw"), checked=False)
    assert checkpoint_bytes(run) == 2 * 4 * 28 + 2 * 4 * 28  # last and best; two moments


def test_the_size_of_a_network_of_another_author_is_not_known() -> None:
    run = specify_run(("+experiment=mfnet", "model=external/dformer_l"), checked=False)
    assert checkpoint_bytes(run) is None
    assert lacking(run)["checkout"].startswith("model.checkout=FOLDER of the author's code (")


def test_a_run_lacks_what_its_upstream_run_lacks(tmp_path: Path) -> None:
    words = (
        "+experiment=sh_adversarial",
        "scale=paper",
        "model.weights=experiment:sh_source/last.pt",
    )
    found = lacking(specify_run(words, checked=False))
    assert found["data"] == "dataset.root=FOLDER of freiburg"
    assert found["weights"].startswith("DeepLab_resnet_pretrained_init-f81d91e8.pth (")
    given = (*words, f"dataset.root={tmp_path}", "pretrained=x.pth")
    assert lacking(specify_run(given, checked=False)) == {}
    wrong = specify_run((*given[:-2], f"dataset.root={tmp_path / 'no'}"), checked=False)
    assert lacking(wrong)["data"] == f"dataset.root={tmp_path / 'no'}, which is no folder"


def test_memory_of_a_step_grows_with_images_and_pixels() -> None:
    """Swin-S with CRM, GiB as counted: 1.75 for weights, 4.70 at batch 1, 2.40 a further image."""
    gib = 2**30 / 1e9
    run = specify_run(PAPER, checked=False)
    assert step_gb(run, 14) == pytest.approx((4.70 + 13 * 2.40) * gib)
    # Images of 512 x 640 have four times the pixels of 256 x 320.
    large = specify_run((*PAPER, "scale.crop_hw=[512,640]"), checked=False)
    assert step_gb(large, 1) == pytest.approx((1.75 + 4 * 2.95) * gib, rel=1e-6)
    less = specify_run((*PAPER, "trainer.activation_checkpointing=true"), checked=False)
    assert step_gb(less, 14) == pytest.approx((2.79 + 13 * 0.49) * gib)
    for words in (PAPER[:1], ("+experiment=baseline", "scale=paper")):
        assert step_gb(specify_run(words, checked=False), 1) is None, "it was not counted"


def test_page_has_the_counted_memory() -> None:
    page = (ROOT / "docs" / "how-to" / "fit-into-memory.md").read_text()
    rows = re.findall(r"^\|(.*\d+x\d+) \|(.*)\|(.*)\|(.*)\|$", page, re.MULTILINE)
    assert len(rows) == len(MEMORY)
    for (name, one, paper, recomputed), row in zip(rows, MEMORY, strict=True):
        assert "{}x{}".format(*row["crop"]) in name
        batch, _, gib = paper.partition(": ")
        further = int(batch) - 1
        less = row["recomputed"][0] + further * row["recomputed"][1]
        expected = (row["first"], row["first"] + further * row["further"], less)
        assert (float(one), float(gib), float(recomputed)) == pytest.approx(expected, abs=0.06)


@pytest.mark.slow
def test_memory_is_that_of_the_benchmark() -> None:
    """The network that is counted in a few seconds stands for all: CMX has the same loss."""
    case = bench_memory.Case("mfnet")
    (row,) = [row for row in MEMORY if row["model"] == "mfnet"]
    found = [bench_memory.counted(case, n, bf16=False, recomputed=False) for n in (1, 2)]
    one, two = ((4 * count["weights"] + count["activations"]) / 1024 for count in found)
    assert (one, two - one) == pytest.approx((row["first"], row["further"]), abs=0.01)


def test_room_on_the_disk(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "not" / "yet") == pytest.approx(free_bytes(tmp_path), rel=0.01)
    assert (in_gb(50_054_208), in_gb(1.88e9)) == ("50 MB", "1.9 GB")
