"""The command `rgbt`: every command's help and mistakes, completion, folders that shadow ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rgbt import __version__
from rgbt.__main__ import help_text, main
from rgbt.config.completion import BASH, OF_HYDRA, SCRIPTS, candidates
from rgbt.config.plain_command import COMMANDS
from tests.commands import Call, assert_one_sentence

ROOT = Path(__file__).resolve().parents[1]


def python(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A Python with our packages installed, in a folder of the user's."""
    lines = f"import sys\nsys.path.append({str(ROOT)!r})\n"
    (folder / "site").mkdir(exist_ok=True)
    (folder / "site" / "sitecustomize.py").write_text(lines)
    variables = {**os.environ, "PYTHONPATH": str(folder / "site"), **environment}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True)


def rgbt(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The console script."""
    script = folder / "site" / "rgbt"
    script.parent.mkdir(exist_ok=True)
    script.write_text("from rgbt.__main__ import main\nif __name__ == '__main__':\n    main()\n")
    return python(folder, str(script), *words)


@pytest.fixture
def shadowed(tmp_path: Path) -> Path:
    """A folder that holds packages of the user's called as ours, and a masker of the user's."""
    for name in ("sweeps", "analysis"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    text = "from rgbt.maskers.masker import Masker\nclass Mine(Masker):\n    pass\n"
    (tmp_path / "my_masks.py").write_text(text)
    return tmp_path


def test_help_lists_every_command_and_its_module_exists() -> None:
    shown = help_text()
    for name, entry in COMMANDS.items():
        assert f"\n  {name} " in shown
        assert len(f"  {name:<13}{entry.about}") <= 80
        text = (ROOT / f"{entry.module.replace('.', '/')}.py").read_text()
        assert 'if __name__ == "__main__"' in text, entry.module


def test_version_is_shown_without_torch(tmp_path: Path) -> None:
    code = "import sys, rgbt.__main__ as m; sys.argv = ['rgbt', '--version']\ntry: m.main()\n"
    code += "except SystemExit: print(sorted({'torch', 'hydra', 'omegaconf'} & set(sys.modules)))"
    assert python(tmp_path, "-c", code).stdout == f"rgbt {__version__}\n[]\n"


def test_help_loads_neither_torch_nor_hydra(tmp_path: Path) -> None:
    code = "import sys, rgbt.__main__ as m; sys.argv = ['rgbt', '--help']\ntry: m.main()\n"
    code += "except SystemExit: print(sorted({'torch', 'hydra', 'omegaconf'} & set(sys.modules)))"
    assert python(tmp_path, "-c", code).stdout.splitlines()[-1] == "[]"


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("name", COMMANDS)
def test_command_explains_itself_and_refuses_a_wrong_option(
    name: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    code, out, err = call(main, name, "--help")
    assert (code, err) == (0, "")
    assert ("rgbt run" if name in OF_HYDRA else f"usage: rgbt {name} ") in out or name == "weights"
    words = {"weights": ("inspect", "x.pth"), "reproduce": ("table=spatialseg/table3",)}
    code, out, err = call(main, name, *words.get(name, ()), "spilt=1")
    assert (code, out) == (2, "")
    assert_one_sentence(err, "'spilt'")
    assert "known: " in err or "did you mean" in err


def test_unknown_command_names_the_nearest(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    code, _, err = call(main, "evaluat", "run=x")
    assert code == 2
    assert_one_sentence(err, "'evaluat' is not a command; did you mean 'evaluate'?")


# Folders of the user's.

GRID = ("-m", "+experiment=grbm", "seed=0,1", "tracking=none", "hydra.sweeper.dry_run=true")


def test_python_m_says_which_folder_shadows_sweeps(shadowed: Path) -> None:
    wrong = python(shadowed, "-m", "rgbt.run", *GRID)
    assert wrong.returncode == 2
    assert_one_sentence(wrong.stderr, f"{shadowed}/sweeps would be imported instead of rgbt's own")
    assert "type `rgbt ...`" in wrong.stderr


def test_console_script_is_not_shadowed(shadowed: Path) -> None:
    right = rgbt(shadowed, "run", *GRID, "masker._target_=my_masks.Mine")
    assert right.returncode == 0, right.stderr
    assert "seed=1" in right.stdout


@pytest.mark.slow
def test_trials_of_the_console_script_are_not_shadowed(shadowed: Path) -> None:
    short = ("trainer.max_steps=1", "trainer.eval_every=1", "trainer.accelerator=cpu")
    words = (*GRID[:-1], "trainer.threads=1", *short, "masker._target_=my_masks.Mine")
    right = rgbt(shadowed, "run", *words)
    assert right.returncode == 0, right.stdout + right.stderr
    assert len(list(shadowed.glob("runs/*/result.json"))) == 2


# Completion.


@pytest.mark.parametrize(
    ("line", "some"),
    [
        ("rgbt ", {"run ", "evaluate ", "--help "}),
        ("rgbt ev", {"evaluate "}),
        ("rgbt evaluate sp", {"split="}),
        ("rgbt compare missing=", {"missing=refuse ", "missing=leave_out "}),
        ("rgbt cache remove=t", {"remove=true "}),
        ("rgbt score datas", {"dataset=", "dataset."}),
        ("rgbt score dataset=synth dataset.num", {"dataset.num_train="}),
        ("rgbt weights ", {"inspect ", "export "}),
        ("rgbt weights export fo", {"format="}),
        ("rgbt reproduce n", {"new "}),
        ("rgbt reproduce new exp", {"experiment="}),
        ("rgbt run +experiment=gr", {"+experiment=grbm"}),
        ("rgbt run +experiment=grbm,c", {"+experiment=grbm,crm"}),
        ("rgbt run +experiment=grbm masker.si", {"masker.sigma_div="}),
        ("rgbt run -m mod", {"model=", "model."}),
        ("rgbt run -", {"-m", "--multirun"}),
        ("rgbt check data", {"dataset=", "dataset."}),
        ("rgbt nothing x", set()),
        ("rgbt compare dat", set()),
        ("rgbt sync runs_dir=a u=b", set()),
    ],
)
def test_completion_offers_what_fits_the_word(line: str, some: set[str]) -> None:
    found = candidates(line)
    assert some <= set(found)
    assert bool(some) == bool(found)
    last = "" if line.endswith(" ") else line.split()[-1]
    assert all(each.startswith(last) for each in found)


def test_commands_of_hydra_are_those_without_options() -> None:
    for name, entry in COMMANDS.items():
        text = (ROOT / f"{entry.module.replace('.', '/')}.py").read_text()
        assert ("@command(" in text) == (name in OF_HYDRA), name


def test_scripts_complete_only_rgbt() -> None:
    for shell, script in SCRIPTS.items():
        assert "rgbt --complete" in script
        assert "python" not in script, shell


@pytest.mark.parametrize(
    ("line", "replies"),
    [
        ("rgbt run +experiment=grbm_r", ["grbm_released"]),
        ("rgbt compare a=x missing=l", ["leave_out "]),
    ],
)
def test_bash_completes_behind_the_last_word_break(
    line: str, replies: list[str], tmp_path: Path
) -> None:
    (tmp_path / "rgbt").write_text(f'#!/bin/sh\ncd {ROOT}; exec {sys.executable} -m rgbt "$@"\n')
    (tmp_path / "rgbt").chmod(0o755)
    typed = f"COMP_LINE='{line}' COMP_POINT={len(line)}; _rgbt"
    shown = "printf '%s\\n' \"${COMPREPLY[@]}\""
    path = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    command = ["bash", "-c", f"{BASH}\n{typed}\n{shown}"]
    done = subprocess.run(command, env=path, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:-1] == replies
