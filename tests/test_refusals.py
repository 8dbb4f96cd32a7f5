"""Input that commands refuse: one sentence with the key, exit code 2, no files written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt import consistency, evaluate, predict, robustness
from rgbt.data.pseudo_labels import FORMAT
from rgbt.files.plain_files import write_json
from rgbt.run import main
from tests.commands import (
    DAYS_AND_NIGHTS,
    SMALL,
    SPLITS,
    Call,
    Trained,
    assert_one_sentence,
    short,
    train,
)
from tests.conftest import write_data

TEMPORAL = ("+experiment=temporal_con", "masker.patch_size=null")

RUN = [
    *(
        ("+experiment=gbrm", "did you mean 'grbm', 'crm' or 'grbm_kp'? known: 72"),
        ("optimizer.lrr=1", "'optimizer.lrr'"),
    ),
    *(("+loss.spatial.alfa=1", "'loss.spatial.alfa'"), ("+sead=1", "'sead'")),
    *(("optimizer.lr=fast", "'optimizer.lr'"), ("trainer.clip_norm=nan", "'trainer.clip_norm'")),
    *(("seed=[0,1]", "'seed'"), ("seeds=3", "'seeds'"), ("learning", "'learning'")),
    ("--experiment=grbm", "'--experiment=grbm' is not an option"),
    ("runs_dir=/dev/null/no", "runs_dir=/dev/null/no: cannot write in /dev/null (Not a directory"),
    *(("model.width", "'model.width': expected KEY=VALUE"), ("=3", "'=3': expected KEY=VALUE")),
    ("model.width=[1", "'model.width=[1': no viable alternative"),
    ("-m hydra.sweeper.study=nan seed=0,1", "'hydra.sweeper.study': expected a finite value"),
    ("-m hydra/launcher=joblib seed=0,1", "its n_jobs is hydra.sweeper.workers"),
    ("-m hydra.sweeper.wait=false seed=0,1", "hydra.sweeper.wait=false"),
    ("transform.crop_hw=[48,inf]", "'transform.crop_hw[1]': expected a finite value, got inf"),
    ("hydra.searchpath=[/no/where]", "the folder /no/where does not exist"),
    ("trainer.accelerator=gpu", "'trainer.accelerator': write cuda"),
    ("dataset.root=???", "docs/how-to/prepare-data-sets.md"),
    *(("trainer.accelerator=mps", "trainer.accelerator"), ("out=x.png", "out=x.png")),
    *(("model.num_classes=5", "num_classes is 5"), ("trainer.selection_split=vall", "'vall'")),
    *(
        ("~dataset.root", "'dataset.root'"),
        ("dataset.root=/no/such", "dataset.root: no such folder: /no/such"),
    ),
    *(("masker.patch_size=48", "masker.patch_size"), ("masker=none scheme=crm", "hides_cells")),
    ("data.batch_size=9", "data.batch_size is 9"),
    (
        "+experiment=rgb_teacher_semseg masker=square data.batch_size=1",
        "data.batch_size=1: SemsegPSPNet normalises one value",
    ),
    *(
        (f"+experiment=temporal_con {words}", word)
        for words, word in (
            ("consistency.splits=[]", "consistency.splits"),
            ("scheme.view.camera.height=1024", "set the intrinsics of your camera"),
            ("consistency.view.camera.cx=900", "principal point"),
            ("scheme.view.yaw=[-50,50]", "a rectangle of 0 %"),
            *(("scheme=supervised", "frames=2"), ("loss.second=none", "loss.beta=1")),
            ("loss@loss.segmentation=set_criterion", "outputs=masks"),
            ("consistency.sets=released_1", "'consistency.sets'"),
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
    given = {word.partition("=")[0] for word in words}
    usual = [*(() if "+experiment" in given else ["+experiment=grbm"]), "dataset=mfnet"]
    usual += [] if "~dataset.root" in given else [f"dataset.root={files}"]
    unmasked = "masker=none" in words or words[0] in TEMPORAL
    left_out = {*given, *(["masker.patch_size"] if unmasked else [])}
    small = [word for word in SMALL if word.partition("=")[0] not in left_out]
    place = (f"runs_dir={tmp_path}", "tracking=none", *short(1))
    code, printed, err = call(main, *usual, *place, *small, *words)
    assert code == 2, err
    assert_one_sentence(err, word)
    assert (printed, len(err.splitlines())) == ("", 1), "nothing is printed before"
    assert not list(tmp_path.iterdir())


ADAPTATION = [
    ("sh_both domains.target.labels=/no/such", "domains.target.labels=/no/such"),
    ("sh_both domains.target.labels=FOLDER", "have the classes road, car, but synth_freiburg"),
    ("sh_source scheme=adversarial_thesis", "num_domains=2"),
    ("sh_adversarial domains.target.labels=given", "target_labels="),
    ("self_training_night scheme.masked_weight=0", "hides_cells="),
    ("self_training_night scheme=self_training_distance model.weights=null", "pretrained="),
    ("sh_source domains.source.labels=none", "every scheme requires labels of the source"),
    ("sh_source model.heads=[source,target]", "heads="),
    ("heatnet_no_teacher domains.source.view=thermal", "views="),
    ("sh_source domains.source.split=dusk", "no split 'dusk'"),
    ("self_training_night scale.batch_size=6", "has only 5"),
    # Of the requested run and of its upstream runs, before any of them is trained.
    ("multi_head_night scheme.weight=-1", "'scheme.weight'"),
    ("multi_head_night_stage1 masker=square", "hides_cells="),
]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the embedded data set of days and nights is drawn."""
    return tmp_path_factory.mktemp("drawn")


@pytest.mark.parametrize(("text", "word"), ADAPTATION, ids=[text for text, _ in ADAPTATION])
def test_domains_that_do_not_fit_are_one_sentence(
    call: Call, drawn: Path, tmp_path: Path, text: str, word: str
) -> None:
    folder = tmp_path / "labels"
    folder.mkdir()
    said = {"format": FORMAT, "digest": "abc", "classes": ["road", "car"]}
    write_json(folder / "pseudo_labels.json", said)
    experiment, *words = text.replace("FOLDER", str(folder)).split()
    place = (f"dataset.cache_dir={drawn}", f"runs_dir={tmp_path / 'runs'}", *short(2))
    code, _, err = call(main, f"+experiment={experiment}", *DAYS_AND_NIGHTS, *place, *words)
    assert code == 2, err
    assert_one_sentence(err, word)
    assert not list(tmp_path.glob("runs/*/*"))


FILE = "images/00003N.png"


@pytest.mark.parametrize(
    ("name", "spoiled", "said"),
    [
        ("labels/00003N.png", np.full((48, 64), 9, np.uint8), "label value 9 "),
        (FILE, np.zeros((48, 64, 3), np.uint8), "expected 4 channels"),
        (FILE, 100, "00003N.png cannot be decoded"),
        ("test.txt", None, "split 'test' of mfnet is empty: expected test.txt"),
    ],
)
def test_run_bad_files_are_named(
    call: Call, data: Path, tmp_path: Path, name: str, spoiled: Any, said: str
) -> None:
    if isinstance(spoiled, int):  # bytes that are left
        (data / name).write_bytes((data / name).read_bytes()[:spoiled])
    elif spoiled is None:
        (data / name).unlink()
    else:
        cv2.imwrite(str(data / name), spoiled)
    code, _, err = train(call, data, tmp_path / "runs", "+experiment=crm", *short(4))
    assert code == 2, err
    assert_one_sentence(err, said)
    assert not list(tmp_path.glob("runs/*/result.json"))


# ---- commands that read a run ---------------------------------------------------------------

CRM = ("+experiment=crm", *short(1))
TWO_FRAMES = (*TEMPORAL, *short(2))
RUN_REFUSALS = {
    evaluate.entry: (
        CRM,
        [
            *(("modality=infrared", "modality"), ("split=tset", "'tset'")),
            *(("checkpoint=first", "'checkpoint'"), ("model.num_queries=3", "'model.num_queries'")),
            *(("data.batch_siz=1", "'data.batch_size'"), ("head=source", "head=source")),
            ("batch_norm=adabn batch_norm_splits=tset", "'tset'"),
            ("data.eval_batch_size=[1", "data.eval_batch_size"),
            *(("severity=1", "severity"), ("corruption=noise", "severity")),
        ],
    ),
    predict.entry: (
        CRM,
        [
            *(("", "input="), ("rgb=a.png thermal=b.png", "rgb=a.png: there is no such")),
            ("rgb=a.png thermal=b.png input=val", "input="),
            *(("input=vall", "'val'"), ("input=val dataset.rot=x", "'dataset.root'")),
            ("input=val threshold=0.5", "threshold=0.5 requires pseudo_labels=true"),
            ("input=val pseudo_labels=maybe", "'pseudo_labels'"),
            ("input=val pseudo_labels=true threshold=2", "threshold"),
            ("input=val pseudo_labels=true label_map=x", "there is no label_map 'x'"),
        ],
    ),
    consistency.entry: (
        TWO_FRAMES,
        [
            *(("frames=nxt", "'frames'"), ("frames=next", "has no second frames")),
            ("consistency=none", "consistency.sets is empty"),
            ("consistency.sets=[released_4]", "'released_3'"),
            ("camera@consistency.view.camera=no", "there is no camera 'no'"),
            ("scheme.view.mode=rotation", "scheme.view.mode"),
        ],
    ),
    robustness.entry: (
        CRM,
        [
            ("corruptions=blurr", "'blur'"),
            ("run=a,b out=x", "out="),
        ],
    ),
}
CASES = [(e, w, text, word) for e, (w, cases) in RUN_REFUSALS.items() for text, word in cases]


@pytest.mark.parametrize(("entry", "words", "text", "word"), CASES, ids=[c[2] for c in CASES])
def test_request_that_does_not_fit_is_one_sentence(
    call: Call,
    trained: Trained,
    tmp_path: Path,
    entry: Callable[[], None],
    words: tuple[str, ...],
    text: str,
    word: str,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder = trained(*words)
    capfd.readouterr()
    before = sorted(path.name for path in folder.rglob("*"))
    out = [f"out={tmp_path / 'out'}"] if entry is predict.entry else []
    code, printed, err = call(entry, f"run={folder}", *out, *text.split())
    assert code == 2, err
    assert_one_sentence(err, word)
    assert (printed, len(err.splitlines())) == ("", 1), "nothing is printed before"
    assert sorted(path.name for path in folder.rglob("*")) == before
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
