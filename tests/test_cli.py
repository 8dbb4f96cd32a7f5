"""The command `rgbt`: help and mistakes of every command, exit codes, a user's own folder."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from rgbt import __version__
from rgbt.__main__ import FIRST, main
from rgbt.checks import InputError, RunError
from rgbt.config.command import configuration_help
from rgbt.config.compose import available, groups
from rgbt.config.plain_command import COMMANDS, exit_code
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


@pytest.mark.parametrize("words", [(), ("--help",), ("-h",), ("--all",)])
def test_help_lists_the_commands_of_a_first_day_or_all(words: tuple[str, ...], call: Call) -> None:
    code, out, _ = call(main, *words)
    listed = tuple(line.split()[0] for line in out.splitlines() if line.startswith("  "))
    assert (code, listed) == (0, tuple(COMMANDS) if words == ("--all",) else FIRST)
    assert len(FIRST) == 6


def test_module_of_every_command_exists() -> None:
    for entry in COMMANDS.values():
        text = (ROOT / f"{entry.module.replace('.', '/')}.py").read_text()
        assert 'if __name__ == "__main__"' in text, entry.module


@pytest.mark.parametrize(
    ("words", "shown"),
    [(["--version"], f"rgbt {__version__}"), (["evaluate", "--help"], "Evaluate")],
)
def test_help_loads_neither_torch_nor_hydra(tmp_path: Path, words: list[str], shown: str) -> None:
    code = f"import sys, rgbt.__main__ as m; sys.argv = ['rgbt', *{words}]\ntry: m.main()\n"
    code += "finally: print({'torch', 'hydra', 'omegaconf', 'pydantic'} & set(sys.modules))"
    lines = python(tmp_path, "-c", code).stdout.splitlines()
    assert (lines[0].startswith(shown), lines[-1]) == (True, "set()")


def test_reader_that_ends_is_no_error() -> None:
    line = f"{shlex.quote(sys.executable)} -m rgbt doctor | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], cwd=ROOT, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("141\n", "")


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("name", COMMANDS)
def test_command_explains_itself_and_refuses_a_wrong_option(
    name: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    code, out, err = call(main, name, "--help")
    assert (code, err) == (0, "")
    assert f"usage: rgbt {name} " in out or name == "weights"
    words = {
        "weights": ("inspect", "x.pth"),
        "archive": ("check",),
        "reproduce": ("table=spatialseg/table3",),
    }
    for given in ((name, *words.get(name, ()), "spilt=1"), (f"{name}x\x1b[2J", "spilt=1")):
        code, out, err = call(main, *given)
        assert (code, out) == (2, "")
        assert_one_sentence(err, "'spilt'" if given[0] == name else f"'{name}x?[2J' is not a comm")


def test_help_of_run_lists_the_choices_that_hydra_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "experiment" / "mine.yaml"
    own.parent.mkdir()
    own.write_text("name: mine\n_variants_: {one: {}, two: {}}\n")
    monkeypatch.setenv("RGBT_CONF", str(tmp_path))
    lines = " ".join(configuration_help(lambda config, words: None).split())
    for group in set(groups()) - {"hydra"}:
        assert f" {group}: {', '.join(available(group))} " in lines
    assert " model/inputs: caffe, " in lines
    assert "mine_one, mine_two" in lines


def test_exit_code_of_an_error() -> None:
    def fail(error: BaseException) -> int:
        raise error

    assert exit_code(lambda: fail(InputError("wrong"))) == 2
    assert exit_code(lambda: fail(RunError("diverged"))) == 1
    assert exit_code(lambda: fail(KeyboardInterrupt())) == 130
