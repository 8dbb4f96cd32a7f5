"""Stored words of a stranger: no command composes, imports, expands or writes by one of them."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from analysis.archive import add, archived, unpack
from analysis.archive import entry as archive
from analysis.compare import entry as compare
from rgbt.checks import InputError
from rgbt.config import compose
from rgbt.config.stored_config import check_words
from rgbt.evaluate import entry as evaluate
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder, read_description, read_result
from rgbt.runs.result import RunResult
from rgbt.tracking.sync import entry as sync
from sweeps.claims import entry as claims
from sweeps.judge import stored_tables
from sweeps.plan.request import REQUESTED, TAG
from sweeps.report import entry as report
from sweeps.reproduce import entry as reproduce
from sweeps.run.optuna_study import open_storage, storage_url, study_folder
from sweeps.study import entry as study
from tests.commands import Call, Trained, short
from tests.measured import remeasured

TABLE, LABEL, SECRET = "crm/table3a", "CRM", "s3cr3t"
SHELL = "posix.system"
HOSTILE = {
    "package": "hydra.searchpath=[pkg://runs.{key}]",
    "folder": "hydra.searchpath=[file://{root}/evil]",
    "climbing": "+experiment=../../../evil",
    "climbing_in": "masker=../../evil/masker",
    "absolute": "masker={root}/evil/masker",
    "launcher": "hydra/launcher=evil",
    "moved": "masker@evil=crm",
    "environment": "name=evil${{oc.env:TOKEN}}",
    "decoded": "dataset.root=${{oc.decode:evil}}",
    "target": "+evil={{_target_: " + SHELL + ", command: touch {root}/mark}}",
    "option": "--config-dir={root}/evil",
    "trust": "trust=evil",
    "class": "model._target_=evil.f",
    "checkout": "model.checkout={root}/evil",
    "link": "trainer.x=[evil](https://evil.example)",
    "controls": "trainer.x=evil\x9b31m\u202e",
    "seeds": "seeds._target_=evil",
}
# Settings instead of words: scale, experiment, and the run that the weights come from.
SETTINGS = {
    "scale": ("\n  name: demo", "\n  name: ../../evil"),
    "name": ("\nname: crm", "\nname: ../../../evil"),
    "upstream": ("weights: null", "weights: experiment:../../../evil/best.pt"),
    "seeds=": ("rgbt.runs.run_spec.Seeds", "rgbt_evil.made"),
    "seeds.start=": ("start: common", "start: {_target_: rgbt_evil.made}"),
    "model.weights=": ("weights: null", "weights: {root}/evil/pipe"),
}
SAMPLER = "  sampler: uniform\n"
PLAIN = ("masker=crm", "trainer.max_steps=9", "~dataset.splits.test_day", "model/inputs=unit")
ACTS = "from pathlib import Path\nPath({!r}).touch()\n"


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_word_that_acts_is_refused_by_name(kind: str) -> None:
    word = HOSTILE[kind].format(key="abc", root="/tmp/r")
    with pytest.raises(InputError, match="the tag: the word .* is not one of a setting"):
        check_words([*PLAIN, word], "the tag")


def test_words_of_settings_are_taken() -> None:
    more = ("optimizer.lr=-1e-3", "pretrained.cmx=/a/b.pth", "masker.patch_size=${px:16}")
    more += ("pretrained=/a/b.pth", "dataset.ids.7=person", "+dataset.lists.test-night=a.txt")
    check_words([*PLAIN, *more], "the tag")
    with pytest.raises(InputError):
        check_words(["masker.patch_size=${px:${oc.env:HOME}}"], "the tag")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, trained: Trained) -> Path:
    """Runs with hostile words in ``run.json``, tags and settings; a study; an archive."""
    import optuna

    root = tmp_path_factory.mktemp("words")
    done = trained("+experiment=crm", *short(1))
    mark = ACTS.format(str(root / "mark"))
    (root / "evil").mkdir()
    (root / "evil" / "masker.yaml").write_text("evil: 1\n")
    (root / "rgbt_evil.py").write_text(f"{mark}def made(**_):\n    pass\n")
    (root / "evil.yaml").write_text("# @package _global_\nevil: 1\n")
    words = [word.format(key=done.name, root=root) for word in HOSTILE.values()]
    for number, word in enumerate([*words, *SETTINGS]):
        key = f"{number:012x}" if number else done.name  # one run has the key of its weights
        folder = Path(shutil.copytree(done, root / "runs" / key))
        known, result = read_description(folder), read_result(folder)
        assert known is not None
        assert result is not None
        (folder / "__init__.py").write_text(mark)
        tags = {**known.tags, TAG + TABLE: LABEL, REQUESTED + TABLE: f"paper '' {word!r}"}
        if number >= len(words):
            tags.pop(REQUESTED + TABLE)
        described = replace(known, tags=tags, overrides=[*known.overrides, word])
        RunFolder(folder).describe(described)
        for file in folder.rglob("*.npz"):
            counts = Counts.load(file)
            remeasured(counts, run=key if counts.measurement.run else "").save(file)
        write_json(folder / "result.json", {**result, "key": key})
        config = (folder / "config.yaml").read_text()
        old, new = SETTINGS.get(word, ("", ""))
        new = new.replace("{root}", str(root))
        assert old in config
        # Archived runs lack a setting of today, so that rekey renames them.
        assert SAMPLER in config
        RunFolder(folder).write_config(config.replace(SAMPLER, "").replace(old, new, 1))
        add(RunResult(folder), root / "results")
        RunFolder(folder).write_config(config.replace(old, new, 1))
    (root / "runs" / "__init__.py").write_text(mark)
    study_folder(root / "runs", "s").mkdir(parents=True)
    opened = open_storage(storage_url(None, root / "runs", "s"))
    made = optuna.create_study(study_name="s", storage=opened)
    key, value = words[0].split("=", 1)
    made.add_trial(
        optuna.create_trial(
            params={key: value},
            distributions={key: optuna.distributions.CategoricalDistribution([value])},
            value=0.5,
            user_attrs={"rgbt.overrides": words, "rgbt.label": words[0]},
        )
    )
    return root


# Command, words, and exit code.
COMMANDS: dict[str, tuple[Any, tuple[str, ...], int]] = {
    "report": (report, ("out=report", "resamples=100"), 0),
    "check": (archive, ("check",), 1),
    "rekey": (archive, ("rekey",), 0),
    "claims": (claims, (f"table={TABLE}", "scale=demo"), 0),
    "study": (study, ("name=s",), 0),
    "compare": (compare, ("a={0}", "b={1}", "resamples=100"), 2),
    "reproduce": (reproduce, (f"table={TABLE}", "seeds=1", "dry_run=true", "tracking=none"), 0),
    "evaluate": (evaluate, ("run={0}", "split=test", "trainer.accelerator=cpu"), 0),
    "sync": (sync, (), 0),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_composes_a_stored_word(
    call: Call, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    root = Path(shutil.copytree(made, tmp_path / "here"))
    monkeypatch.chdir(root)
    monkeypatch.syspath_prepend(str(root))
    monkeypatch.setenv("TOKEN", SECRET)
    monkeypatch.setattr(stored_tables, "table_names", lambda *_: [TABLE])
    composed: list[str] = []
    divided = compose._divided

    def spied(words: tuple[str, ...]) -> Any:
        composed.extend(words)
        return divided(words)

    monkeypatch.setattr(compose, "_divided", spied)
    entry, words, expected = COMMANDS[name]
    (own,) = (
        path.parent for path in root.glob("runs/*/run.json") if path.parent.name[:5] != "00000"
    )
    keys = [str(own), "runs/000000000001"]
    runs = ["runs_dir=runs"] if name not in ("check", "rekey") else ["archive=results"]
    code, out, err = call(entry, *[word.format(*keys) for word in words], *runs)
    assert code == expected, err
    assert not [word for word in composed if "evil" in word or word.startswith("hydra")]
    assert not {each for each in sys.modules if each.startswith(("runs", "evil", "rgbt_evil"))}
    assert not list(tmp_path.rglob("mark"))
    assert SECRET not in out + err
    for path in archived(root / "results"):
        unpack(path, tmp_path / "unpacked")
    for file in (path for path in tmp_path.rglob("*") if path.is_file()):
        assert SECRET.encode() not in file.read_bytes(), file
