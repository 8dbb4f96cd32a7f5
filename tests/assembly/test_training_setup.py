"""Before anything is trained or written: the labels of the domains, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rgbt.assembly import training_setup
from rgbt.assembly.training_setup import set_up_training, validate
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data import rare_classes
from rgbt.data.labels import classes_in
from rgbt.data.pseudo_labels import FORMAT
from rgbt.engine.device import TrainingForward
from rgbt.files.plain_files import write_json
from rgbt.run import main
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.specify import specify
from tests.commands import Call, assert_one_sentence
from tests.conftest import write_png
from tests.data import layouts

SIZES = (
    *("dataset=synth_freiburg", "dataset.num_train_day=3", "dataset.num_train_night=2"),
    *("dataset.num_val=1", "dataset.num_test=2", "scale.batch_size=1", "scale.critic_width=4"),
    *("trainer.accelerator=cpu", "trainer.threads=1", "data.num_workers=0", "tracking=none"),
)
Composed = Callable[..., RunSpec]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def words(cache: Path, tmp_path: Path) -> Callable[..., list[str]]:
    place = (f"dataset.cache_dir={cache}", f"runs_dir={tmp_path / 'runs'}")
    return lambda name, *more: [f"+experiment={name}", *SIZES, *place, *more]


@pytest.fixture
def composed(words: Callable[..., list[str]]) -> Composed:
    def make(name: str, *more: str) -> RunSpec:
        return specify(compose(words(name, *more)))

    return make


def test_probe_of_a_batch_of_one_leaves_no_trace(composed: Composed) -> None:
    model = set_up_training(composed("start_deeplabv2")).session.model
    norms = [module for module in model.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    assert norms
    for norm in norms:
        assert norm.training
        assert norm.num_batches_tracked == 0
        assert not norm.running_mean.any()


def test_class_weights_are_those_of_the_training_split(composed: Composed) -> None:
    """Of the loss, and of a loss inside another one; numbers do not read a label."""
    spec = composed("start_deeplabv2", "loss.class_weights=inverse")
    setup = set_up_training(spec)
    data = setup.session.dataset
    labels = [data.label(name) for name in data.names("train_day")]
    pixels = np.bincount(np.ravel(labels), minlength=256)[: data.num_classes]
    expected = [pixels.sum() / len(pixels) / number if number else 0 for number in pixels]
    assert setup.scheme.loss.class_weights == pytest.approx(expected)  # type: ignore[attr-defined]
    inner = ["loss=cross_entropy_auxiliary", "model.auxiliary=true", "loss.loss.class_weights=enet"]
    nested = set_up_training(composed("start_deeplabv2", *inner)).scheme.loss.loss  # type: ignore[attr-defined]
    assert len(nested.class_weights) == data.num_classes
    taught = ["domains.source.labels=experiment:thermal_teacher/best.pt", "loss.class_weights=enet"]
    with pytest.raises(InputError, match=r"loss\.class_weights: expected numbers"):
        set_up_training(composed("start_deeplabv2", *taught), upstream_finished=False)


def test_rare_classes_follow_the_labels_of_the_source(
    composed: Composed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Target images and upstream runs are shuffled; an upstream run has the batch size."""
    words = ["data.sampling=rare_classes", "data.batch_size=2"]
    upstream = composed("self_training_night", *words).upstream[0].data
    assert (upstream.sampling, upstream.batch_size) == ("shuffled", 2)
    counted: list[Any] = []
    drawn: list[Any] = []
    relabelled = SimpleNamespace(names=lambda split: ("a", "b"))
    for module, name, instead in (
        (rare_classes, "count_rare_classes", lambda *args: counted.append(args) or "rare"),
        (training_setup, "train_batches", lambda *args: drawn.append(args)),
        (training_setup, "PairedBatches", lambda *_, **__: None),
        (training_setup, "_labelled", lambda *_: relabelled),
    ):
        monkeypatch.setattr(module, name, instead)
    setup = set_up_training(composed("self_training_night", *words, "model.weights=null"))
    setup.batches(range(1))
    assert [call[:2] for call in counted] == [(relabelled, setup.session.domains.source.split)]
    assert [call[-1] for call in drawn] == ["rare", None]


def write_folder(spec: RunSpec, folder: Path, split: str, **changes: Any) -> Path:
    """A folder that says it is finished, with (empty) files of every image of a split."""
    dataset = spec.dataset.build()
    for name in dataset.names(split):
        (folder / "labels").mkdir(parents=True, exist_ok=True)
        (folder / "labels" / f"{name}.png").touch()
    said = {
        "format": FORMAT,
        "digest": "abc",
        "classes": list(dataset.classes),
        "kept": 0.5,
        "threshold": 0.9,
        "fingerprint": dataset.fingerprint(),
        **changes,
    }
    write_json(folder / "pseudo_labels.json", said)
    return folder


@pytest.mark.parametrize("name", ["source", "target"])
def test_given_labels_that_the_data_set_does_not_have(composed: Composed, name: str) -> None:
    spec = composed("sh_both", f"domains.{name}.split=train_night")
    with pytest.raises(InputError, match=f"domains.{name}.labels=given"):
        set_up_training(spec)


def test_test_images_in_training_give_a_warning(
    composed: Composed, capfd: pytest.CaptureFixture[str]
) -> None:
    def warnings_of(*words: str) -> list[str]:
        capfd.readouterr()
        set_up_training(composed(*words))
        return [line for line in capfd.readouterr().err.splitlines() if "test images" in line]

    assert warnings_of("sh_both") == []
    # One of the two test images is of the day.
    for word, count in (("domains.target.split=test_day", 1), ("domains.source.split=test", 2)):
        (line,) = warnings_of("sh_both", word)
        assert f"{word}: {count} of its images" in line
    # Without their labels they are the images of a target that is adapted to, and may be seen.
    unseen = ("sh_adversarial", "model.weights=null", "domains.target.split=test_night")
    assert warnings_of(*unseen) == []


def refused(call: Call, words: list[str], key: str, runs: Path) -> None:
    before = {*runs.glob("*/*")}
    code, _, err = call(main, *words)
    assert code == 2, err
    assert_one_sentence(err, key)
    assert {*runs.glob("*/*")} == before, "nothing is left behind"


def test_pseudo_labels_of_another_split(
    call: Call, composed: Composed, words: Callable[..., list[str]], tmp_path: Path
) -> None:
    folder = write_folder(composed("sh_both"), tmp_path / "night", "train_night")
    typed = ("sh_both", f"domains.target.labels={folder}")
    refused(call, words(*typed), "domains.target.labels", tmp_path / "runs")
    # A file that is left out among others is none that the run goes without unasked ...
    folder = write_folder(composed("sh_both"), tmp_path / "day", "train_day")
    next(iter((folder / "labels").iterdir())).unlink()
    typed = ("sh_both", f"domains.target.labels={folder}")
    with pytest.raises(InputError, match="no pseudo-labels for 1 of the 3 images of train_day"):
        set_up_training(composed(*typed))
    found = set_up_training(composed(*typed, "data.on_error=skip")).datasets["target"]
    assert len(found.labels.missing(found.names("train_day"))) == 1
    # ... and without any there is nothing to learn from; nor where the threshold kept none.
    write_folder(composed("sh_both"), folder, "train_day", kept=0)
    refused(call, words(*typed), "threshold", tmp_path / "runs")
    shutil.rmtree(folder / "labels")
    with pytest.raises(InputError, match="3 of the 3 images"):
        set_up_training(composed(*typed, "data.on_error=skip"))


def test_predicted_labels_of_other_files(
    call: Call, composed: Composed, words: Callable[..., list[str]], tmp_path: Path
) -> None:
    """Named by their experiment they follow the data; a folder is taken as it is."""
    spec = composed("multi_head_night_stage1")
    labels = spec.upstream[0].folder / "pseudo_labels" / "train_night_thermal_best"
    write_folder(spec, labels, "train_night")
    (spec.upstream[0].folder / "result.json").write_text("{}")
    assert set_up_training(spec).datasets["target"].labels.folder == labels
    write_folder(spec, labels, "train_night", fingerprint="of other files")
    refused(call, words("multi_head_night_stage1"), "other files", tmp_path / "runs")
    typed = (f"domains.target.labels={labels}", "domains.target.teacher_view=null")
    again = set_up_training(composed("multi_head_night_stage1", *typed))
    assert again.datasets["target"].labels.manifest["fingerprint"] == "of other files"


def test_validate_view_of_the_teacher_passes(composed: Composed) -> None:
    for word in ("teacher_view=thermal", "teacher_view=null", "confidence=true"):
        spec = composed("multi_head_night_stage1", f"domains.target.{word}")
        validate(spec)
        assert not spec.folder.exists()


def test_network_settings_are_applied_and_keep_the_loss(composed: Composed) -> None:
    def first_loss(*words: str) -> tuple[torch.nn.Module, torch.Tensor]:
        setup = set_up_training(composed("mfnet", "masker=none", *words))
        loaded = next(setup.batches(range(1))).to("cpu")
        phases = setup.scheme.phases(loaded, lambda _: torch.Generator().manual_seed(0))
        return setup.session.model, torch.stack(list(next(iter(phases)).parts.values())).sum()

    plain, expected = first_loss()
    network, loss = first_loss("trainer.activation_checkpointing=true")
    assert torch.equal(loss, expected)
    assert isinstance(network.get_submodule("conv1_rgb").forward, TrainingForward)
    network, loss = first_loss("trainer.memory_format=channels_last")
    torch.testing.assert_close(loss, expected, rtol=1e-4, atol=0)
    assert not network.get_parameter("conv2_1_rgb.conv.weight").is_contiguous()
    assert list(network.state_dict()) == list(plain.state_dict())


@pytest.mark.parametrize(("source", "changed"), [("weights", 0), ("order", 1), ("masks", None)])
def test_seed_of_source_changes_only_its_own_draws(
    composed: Composed, source: str, changed: int | None
) -> None:
    def drawn(*more: str) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        setup = set_up_training(composed("sh_adversarial", "model.weights=null", *more))
        weights = [*setup.model.parameters(), *setup.others["critic"].parameters()]
        pair: Any = next(setup.batches(range(1)))
        return weights, [pair.source.rgb, pair.target.rgb]

    before, after = drawn(), drawn(f"seeds.{source}=1")
    for index, (one, other) in enumerate(zip(before, after, strict=True)):
        drawings = [both for both in zip(one, other, strict=True) if both[0].unique().numel() > 1]
        is_same = [torch.equal(*both) for both in drawings]
        assert not any(is_same) if index == changed else all(is_same)


def own_data(root: Path, *more: str) -> RunSpec:
    """A run on frames train_1, train_2, ... in the layout of `write_folder`."""
    patterns = [f'dataset.{key}="{text}"' for key, text in layouts.PATTERNS.items()]
    data = ["dataset=folder", f"dataset.root={root}", "dataset.thermal_range=[20000,24000]"]
    words = [
        "+experiment=mfnet",
        "scale.batch_size=2",
        *data,
        "dataset.num_classes=3",
        *SIZES[-3:],
        *patterns,
    ]
    return specify(compose([*words, f"dataset.classes=[{','.join(layouts.CLASSES)}]", *more]))


def test_sizes_are_from_smallest_to_largest(tmp_path: Path) -> None:
    """Of all splits as stored, of the test images as predicted; by headers, EXIF included."""
    root = layouts.write_folder(tmp_path / "data")
    assert set_up_training(own_data(root)).sizes == {
        "stored": "6x8",
        "trained": "6x8",
        "predicted": "6x8",
    }
    rgb, counts, label = layouts.of_folder("test_2", hw=(7, 9))
    write_png(root / "test" / "mask" / "2.png", label)
    layouts.write_any(root / "test" / "ir" / "2_ir.tif", counts)
    exif = Image.Exif()
    exif[0x0112] = 6  # stored on its side
    turned = Image.fromarray(np.ascontiguousarray(np.rot90(rgb)))
    turned.save(root / "test" / "rgb" / "2.png", exif=exif)
    setup = set_up_training(own_data(root))
    assert setup.sizes == {
        "stored": "6x8 to 7x9",
        "trained": "6x8",
        "predicted": "6x8 to 7x9",
    }
    assert np.array_equal(setup.session.dataset.read("test_2").rgb, rgb)


def test_classes_that_no_label_shows_are_named(tmp_path: Path) -> None:
    root = layouts.write_folder(tmp_path / "data")
    assert set_up_training(own_data(root)).absent == ()
    for path in (root / "test" / "mask").iterdir():
        write_png(path, np.where(np.eye(6, 8) > 0, 1, 0).astype(np.uint8))
    assert set_up_training(own_data(root)).absent == ("test: no label shows car",)
    for path in root.glob("*/mask/*.png"):
        write_png(path, np.where(np.eye(6, 8) > 0, 255, 0).astype(np.uint8))
    text = "the labels show 'background' alone; a score over one class is no score"
    assert set_up_training(own_data(root, "dataset.ignored=[255]")).absent == (
        f"train, val, test: {text}",
    )
    with pytest.raises(InputError, match=r"write ids: \{0: background, 255: person\} if it is"):
        set_up_training(own_data(root))


def test_few_labels_are_read_for_their_classes(tmp_path: Path) -> None:
    """Until every class is seen; at most so many, unless one class alone has been seen."""
    read: list[str] = []
    labels = {f"{number:03}": np.full((1, 2), number == 250) for number in range(300)}
    dataset: Any = SimpleNamespace(
        num_classes=2,
        classes=("a", "b"),
        unscored=(),
        label=lambda name: read.append(name) or labels[name].astype(np.uint8),
    )
    pixels, is_whole = classes_in(dataset, tuple(labels), "raise")
    # Every third one, and then those of 0 to 250 that are no multiples of 3.
    assert (pixels.tolist(), is_whole) == ([2 * (100 + 166), 2, 0], False)
    assert (len(read), read[:3]) == (100 + 167, ["000", "003", "006"])
    dataset.num_classes, dataset.classes = 3, ("a", "b", "c")
    labels["003"] = np.ones((1, 2))
    read.clear()
    assert classes_in(dataset, tuple(labels), "raise")[1] is False
    assert len(read) == 100
    read.clear()
    assert classes_in(dataset, tuple(labels)[:90], "raise")[1] is True
    assert len(read) == 90
    dataset.unscored = ("c",)
    assert classes_in(dataset, tuple(labels)[:90], "raise")[1] is False
    assert read[90:] == ["000", "001", "002", "003"]
    dataset.num_classes, dataset.classes, dataset.unscored = 1, ("a",), ()
    del labels["003"], labels["250"], read[:]
    assert classes_in(dataset, tuple(labels), "raise")[1] is False
    assert read == ["000"]
