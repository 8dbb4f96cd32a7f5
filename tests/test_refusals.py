"""Input that commands refuse: one sentence with the key, exit code 2, no files written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt import consistency, evaluate, predict, robustness
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.pseudo_labels import FORMAT
from rgbt.run import main
from tests.commands import SMALL, SPLITS, Call, Trained, assert_one_sentence, short, train
from tests.conftest import write_data
from tests.days_and_nights import DAYS_AND_NIGHTS

TEMPORAL = ("+experiment=temporal_con", "masker.patch_size=null")

RUN = [
    ("+experiment=gbrm", "no experiment 'gbrm'; did you mean 'grbm'?"),
    ("masker=grm", "there is no masker 'grm'"),
    ("optimiser=adamw", "optimiser"),
    ("optimizer.lrr=1", "'optimizer.lrr' is not a key"),
    ("+optimizer.lrr=1", "'optimizer.lrr' is not a setting"),
    ("+loss.spatial.alfa=1", "'loss.spatial.alfa' is not a setting"),
    ("+sead=1", "'sead' is not a key of the configuration"),
    ("optimizer.lr=fast", "'optimizer.lr'"),
    ("+scheme.model=1", "'scheme.model'"),
    ("trainer.accelerator=mps", "trainer.accelerator=mps"),
    ("model.num_classes=5", "model.num_classes is 5"),
    ("learning", "expected key=value"),
    ("trainer.selection_split=vall", "no split 'vall'"),
    ("trainer.clip_norm=nan", "'trainer.clip_norm' must be"),
    ("out=x.png", "omit out=..."),
    ("~dataset.root", "'dataset.root'"),
    ("dataset.root=???", "'dataset.root' has no value"),
    ("dataset.root=/no/such", "the folder '/no/such' does not exist"),
    ("masker.patch_size=48", "masker.patch_size"),
    ("masker.patch_size=6", "masker.patch_size"),
    ("masker=none scheme=crm", "requires hides_cells=true of the masker"),
    ("data.batch_size=9", "data.batch_size is 9"),
    ("+experiment=crm model=rtfnet_tiny loss=cross_entropy", "scheme=supervised"),
    ("+experiment=temporal_con consistency.splits=[]", "consistency.splits is empty"),
    *(
        (f"+experiment=temporal_con {words}", word)
        for words, word in (
            (
                "scheme.view.camera.height=1024 scheme.view.camera.width=1280",
                "intrinsics for another image size",
            ),
            (
                "consistency.view.camera.height=1024 consistency.view.camera.width=1280",
                "intrinsics for another image size",
            ),
            ("scheme.view.camera.cx=900", "intrinsics for another image size"),
            ("scale.crop_hw=[48,48]", "intrinsics for another image size"),
            ("scheme.view.yaw=[-50,50]", "leave no rectangle of the view without empty pixels"),
            (
                "consistency.view.yaw=[-50,50]",
                "leave no rectangle of the view without empty pixels",
            ),
            ("scheme=supervised", "requires frames=2 of the scheme"),
            ("loss=cross_entropy", "requires frames=2 of the loss"),
            ("masker=crm masker.patch_size=32", "choose masker=none"),
            ("loss@loss.segmentation=set_criterion", "requires outputs=masks of the model"),
            ("loss.second=none", "set loss.beta=0"),
            ("loss.beta=0", "set loss.second=none"),
            ("consistency.sets=released_1", "'consistency.sets'"),
            ("camera@scheme.view.camera=sinth", "did you mean 'synth'?"),
        )
    ),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small MFNet that nothing is written to."""
    return write_data(tmp_path_factory.mktemp("refusals") / "mf", SPLITS, (48, 64))


@pytest.mark.parametrize(("text", "word"), RUN, ids=[text[:60] for text, _ in RUN])
def test_run_wrong_setting_is_one_sentence(
    call: Call, files: Path, tmp_path: Path, text: str, word: str
) -> None:
    words = text.split()
    given = {each.partition("=")[0] for each in words}
    usual = [*(() if "+experiment" in given else ["+experiment=grbm"]), "dataset=mfnet"]
    usual += [] if "~dataset.root" in given else [f"dataset.root={files}"]
    unmasked = "masker=none" in words or words[0] in TEMPORAL
    left_out = {*given, *(["masker.patch_size"] if unmasked else [])}
    small = [each for each in SMALL if each.partition("=")[0] not in left_out]
    place = (f"runs_dir={tmp_path}", "tracking=none", *short(1))
    code, _, err = call(main, *usual, *place, *small, *words)
    assert code == 2, err
    assert_one_sentence(err, word)
    assert not list(tmp_path.iterdir())


ADAPTATION = [
    ("sh_both domains.target.labels=/no/such", "domains.target.labels=/no/such: expected given"),
    ("sh_both domains.target.labels=FOLDER", "have the classes road, car, but synth_freiburg"),
    ("sh_source scheme=adversarial_thesis", "Adversarial requires num_domains=2 of the domains"),
    ("sh_both scheme=supervised", "requires num_domains=2 of the scheme"),
    ("sh_adversarial scheme.supervise_target=true", "requires target_labels=true of the domains"),
    ("sh_adversarial domains.target.labels=given", "requires target_labels=false of the domains"),
    ("self_training_night masker=none", "requires hides_cells=true of the masker"),
    ("self_training_night scheme.masked_weight=0", "requires hides_cells=false of the masker"),
    (
        "self_training_night domains.target.labels=experiment:thermal_teacher/best.pt",
        "requires target_labels=false of the domains",
    ),
    (
        "self_training_night scheme=self_training_distance model.weights=null",
        "requires pretrained=true of the model.weights",
    ),
    ("self_training_thermal scheme.augmentation.jitter_strength=0.6", "must be a number from 0"),
    ("sh_source domains.source.labels=none", "every scheme requires labels of the source"),
    ("multi_head_thermal_stage1 domains.source.head=left", "requires heads=left of the model"),
    ("sh_source model.heads=[source,target]", "requires heads=source,target of the domains"),
    ("sh_both model=mask2former_tiny loss=set_criterion", "requires outputs=scores of the model"),
    ("sh_both loss=set_criterion", "requires outputs=masks of the model"),
    ("sh_both masker=square", "requires hides_cells=false of the masker"),
    ("heatnet_no_teacher domains.source.view=thermal", "requires views=thermal of the model"),
    ("sh_source domains.source.split=dusk", "no split 'dusk'"),
    ("sh_both domains.target.split=train_night scale.batch_size=6", "has only 5"),
    # Of the requested run and of its upstream runs, before any of them is trained.
    ("multi_head_night scheme.weight=-1", "'scheme.weight' must be a number from 0"),
    ("multi_head_night_stage1 masker=square", "requires hides_cells=false of the masker"),
    (
        "multi_head_night_stage1 domains.target.teacher_view=rgb",
        "requires views=rgb of the network of domains.target.labels",
    ),
    ("heatnet_no_teacher scheme.weighed_by_confidence=true", "target_confidence=true of the dom"),
]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the embedded data set of days and nights is drawn."""
    return tmp_path_factory.mktemp("drawn")


def adapted(drawn: Path, runs: Path, text: str) -> list[str]:
    experiment, *words = text.split()
    place = (f"dataset.cache_dir={drawn}", f"runs_dir={runs}", *short(2))
    return [f"+experiment={experiment}", *DAYS_AND_NIGHTS, *place, *words]


@pytest.mark.parametrize(("text", "word"), ADAPTATION, ids=[text for text, _ in ADAPTATION])
def test_run_on_two_domains_that_do_not_fit_is_one_sentence(
    call: Call, drawn: Path, tmp_path: Path, text: str, word: str
) -> None:
    folder = tmp_path / "labels"
    folder.mkdir()
    said = {"format": FORMAT, "digest": "abc", "classes": ["road", "car"]}
    (folder / "pseudo_labels.json").write_text(json.dumps(said))
    words = adapted(drawn, tmp_path / "runs", text.replace("FOLDER", str(folder)))
    code, _, err = call(main, *words)
    assert code == 2, err
    assert_one_sentence(err, word)
    assert not list(tmp_path.glob("runs/*/*"))


def test_run_empty_target_split_is_refused_before_its_teacher_is_trained(
    call: Call, drawn: Path, tmp_path: Path
) -> None:
    dataset = build(compose(adapted(drawn, tmp_path, "sh_source")).dataset)
    root = tmp_path / "freiburg"
    shutil.copytree(dataset.root, root)
    for path in [each for each in root.rglob("*night*") if each.is_dir()]:
        if "train" in path.parts:
            shutil.rmtree(path, ignore_errors=True)
    words = adapted(drawn, tmp_path / "runs", "multi_head_night_stage1")
    own = ["dataset=freiburg", f"dataset.root={root}", "dataset.crop=[1,97,48,240]"]
    own.append("dataset.val_sequences=[seq_04_day]")
    code, _, err = call(main, *(each for each in words if not each.startswith("dataset")), *own)
    assert code == 2, err
    assert_one_sentence(err, "train_night")
    assert not list(tmp_path.glob("runs/*/*"))


@pytest.mark.parametrize(
    "words", [(), ("consistency=none", "transform=none")], ids=["measured", "trained"]
)
def test_run_images_of_another_shape_are_refused(
    call: Call, tmp_path: Path, words: tuple[str, ...]
) -> None:
    data = write_data(tmp_path / "mf", SPLITS, (48, 48))
    code, _, err = train(call, data, tmp_path / "runs", *TEMPORAL, *words, *short(1))
    assert code == 2, err
    assert_one_sentence(err, "intrinsics for another image size")
    assert not (tmp_path / "runs").exists()


def test_run_broken_angles_are_refused(call: Call, files: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("yaw,pitch,roll\n80,2,3\n")
    words = (*TEMPORAL, f"consistency.sets=[{tmp_path / 'mine.csv'}]", *short(1))
    code, _, err = train(call, files, tmp_path / "runs", *words)
    assert code == 2, err
    assert_one_sentence(
        err, "yaw 80, pitch 2, roll 3 degrees leave no rectangle of the view without empty pixels"
    )
    assert not (tmp_path / "runs").exists()


def test_run_misspelt_key_in_an_experiment_file_is_refused(
    call: Call, files: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "conf" / "experiment"
    mine.mkdir(parents=True)
    (mine / "mine.yaml").write_text("# @package _global_\ntrainer: {max_step: 3}\n")
    words = ("+experiment=mine", f"hydra.searchpath=[file://{tmp_path / 'conf'}]")
    code, _, err = train(call, files, tmp_path, *words, "masker.patch_size=null")
    assert code == 2
    assert_one_sentence(err, "'trainer.max_step' is not a setting of")
    assert "did you mean 'max_steps'?" in err


def label_of_nine(data: Path) -> str:
    cv2.imwrite(str(data / "labels" / "00003N.png"), np.full((48, 64), 9, np.uint8))
    return "label value 9 is out of range"


def three_channels(data: Path) -> str:
    cv2.imwrite(str(data / "images" / "00003N.png"), np.zeros((48, 64, 3), np.uint8))
    return "expected 4 channels"


def cut_short(data: Path) -> str:
    path = data / "images" / "00003N.png"
    path.write_bytes(path.read_bytes()[:100])
    return "00003N.png cannot be decoded"


def no_test_list(data: Path) -> str:
    (data / "test.txt").unlink()
    return "test.txt' does not exist"


@pytest.mark.parametrize("spoil", [label_of_nine, three_channels, cut_short, no_test_list])
def test_run_bad_files_are_named(
    call: Call, data: Path, tmp_path: Path, spoil: Callable[[Path], str]
) -> None:
    word = spoil(data)
    code, _, err = train(call, data, tmp_path / "runs", "+experiment=crm", *short(4))
    assert code == 2, err
    assert_one_sentence(err, word)
    assert not list(tmp_path.glob("runs/*/result.json"))


def test_run_checkpoint_of_another_model_is_refused(
    call: Call, files: Path, trained: Trained, tmp_path: Path
) -> None:
    folder = trained("+experiment=crm", *short(1))
    words = ("+experiment=crm", "model.num_queries=7", f"model.weights={folder}", *short(1))
    code, _, err = train(call, files, tmp_path, *words)
    assert code == 2
    assert_one_sentence(err, "does not fit this network")


# ---- commands that read a run ---------------------------------------------------------------

CRM = ("+experiment=crm", *short(1))
TWO_FRAMES = (*TEMPORAL, *short(2))
OF_A_RUN = {
    evaluate.entry: (
        CRM,
        [
            ("modality=infrared", "modality: 'infrared' is not a valid choice"),
            ("split=tset", "no split 'tset'"),
            ("checkpoint=first", "'checkpoint' must be 'best' or 'last'"),
            ("model.num_queries=3", "'model.num_queries' of a finished run cannot be changed"),
            ("data.batch_siz=1", "did you mean 'data.batch_size'?"),
            ("scale=paper", "'scale' of a finished run cannot be changed"),
            ("model=mask2former_swin_t", "'model' of a finished run cannot be changed"),
            ("data.eval_batch_size=[1", "data.eval_batch_size cannot be read as YAML"),
            ("head=source", "head=source selects one of two heads"),
            ("degradation=noise", "'degradation' was renamed to 'corruption'"),
            ("severity=1", "'severity' has no effect without corruption="),
            ("corruption.block=1", "'corruption.block' has no effect without corruption="),
            ("corruption=noise", "requires a number (grey levels (std))"),
        ],
    ),
    predict.entry: (
        CRM,
        [
            ("", "got none of input, rgb and thermal"),
            ("rgb=a.png", "got rgb of input, rgb and thermal"),
            ("rgb=a.png thermal=b.png", "a.png is missing"),
            ("rgb=a.png thermal=b.png input=val", "expected either input=FOLDER"),
            ("input=vall", "did you mean 'val'?"),
            ("input=val dataset.rot=x", "did you mean 'dataset.root'?"),
            ("input=val threshold=0.5", "threshold=0.5 requires pseudo_labels=true"),
            ("input=val pseudo_labels=yes", "'pseudo_labels' must be true or false"),
            (
                "input=val pseudo_labels=true threshold=2",
                "threshold must be between 0 and 1, got 2",
            ),
            ("input=pictures pseudo_labels=true", "as input, one of"),
            ("input=val pseudo_labels=true label_map=x", "there is no label_map 'x'"),
            ("input=val head=target", "head=target selects one of two heads"),
        ],
    ),
    consistency.entry: (
        TWO_FRAMES,
        [
            ("frames=nxt", "did you mean 'next'?"),
            ("frames=next", "has no second frames: expected the folder next/"),
            ("consistency=none", "consistency.sets is empty"),
            ("transform.test_short_edge=96", "choose a separate folder for these counts with out="),
            ("trainer.precision=bf16-mixed", "changes how the run is measured"),
            ("modality=rgb", "modality: 'rgb' is not a valid choice"),
            ("consistency.sets=[released_4]", "did you mean 'released_3'?"),
            ("consistency.veiw.mode=both", "did you mean 'view'?"),
            ("consistency=veiws", "there is no consistency 'veiws'"),
            ("camera@consistency.view.camera=no", "there is no camera 'no'"),
            ("consistency.view.camera.cx=900", "intrinsics for another image size"),
            ("scheme.view.mode=rotation", "of a finished run cannot be changed"),
        ],
    ),
    robustness.entry: (
        CRM,
        [
            ("degradations=blur", "'degradations' was renamed to 'corruptions'"),
            ("corruptions=blurr", "did you mean 'blur'"),
            ("metric.absent=exclude", "changes how the run is measured"),
            ("run=a,b out=x", "out= is the folder for a single run, but run= names 2"),
        ],
    ),
}
CASES = [(e, w, text, word) for e, (w, cases) in OF_A_RUN.items() for text, word in cases]


@pytest.mark.parametrize(("entry", "words", "text", "word"), CASES, ids=[c[2] for c in CASES])
def test_request_of_a_run_that_does_not_fit_is_one_sentence(
    call: Call,
    trained: Trained,
    tmp_path: Path,
    entry: Callable[[], None],
    words: tuple[str, ...],
    text: str,
    word: str,
) -> None:
    folder = trained(*words)
    before = sorted(path.name for path in folder.rglob("*"))
    out = [f"out={tmp_path / 'out'}"] if entry is predict.entry else []
    code, _, err = call(entry, f"run={folder}", *out, *text.split())
    assert code == 2, err
    assert_one_sentence(err, word)
    assert sorted(path.name for path in folder.rglob("*")) == before
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize("entry", [evaluate.entry, consistency.entry, robustness.entry])
def test_request_without_a_run_is_one_sentence(
    call: Call, tmp_path: Path, entry: Callable[[], None]
) -> None:
    code, _, err = call(entry)
    assert code == 2
    assert_one_sentence(err, "'run' has no value")
    code, _, err = call(entry, "run=nowhere", f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "run=nowhere is neither a run folder")


def test_run_without_checkpoint_is_refused(call: Call, trained: Trained, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(trained(*CRM), tmp_path / "run"))
    (folder / "best.pt").unlink()
    code, _, err = call(evaluate.entry, f"run={folder}")
    assert code == 2
    assert_one_sentence(err, "has no best.pt, because the run has not reached its first evaluation")
