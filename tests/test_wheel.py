"""An installed wheel carries everything: commands run in an empty folder without this checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import rgbt

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("rgbt", "sweeps", "analysis", "hydra_plugins", "conf")

pytestmark = pytest.mark.slow


def output_of(folder: Path, *command: str | Path) -> str:
    hidden = ("PYTHONPATH", "RGBT_CONF", "RGBT_SHARED")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_installed_commands_run_in_an_empty_folder(tmp_path: Path) -> None:
    """The wheel is built offline from a copy and installed where our dependencies are found."""
    copy, environment, folder = tmp_path / "source", tmp_path / "env", tmp_path / "empty"
    copy.mkdir()
    folder.mkdir()
    for name in (*PACKAGES, "pyproject.toml", "README.md", "LICENSE"):
        copier = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copier(ROOT / name, copy / name)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    output_of(tmp_path, *pip, "wheel", "--no-deps", "--no-build-isolation", "-w", tmp_path, copy)
    (wheel,) = tmp_path.glob("*.whl")
    tracked = output_of(ROOT, "git", "ls-files", *PACKAGES).split()
    files = {
        each.replace("conf/", "rgbt/conf/", 1) if each.startswith("conf/") else each
        for each in tracked
        if (ROOT / each).is_file()
    }
    with zipfile.ZipFile(wheel) as archive:
        carried = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert files - carried == set()
    assert {name for name in carried - files if not name.endswith(".py")} == set()

    venv.create(environment, symlinks=True)
    # The dependencies of this environment, without its own rgbt: *.pth files are not read there.
    (site,) = (environment / "lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    # Not --force-reinstall: even with a prefix it removes the rgbt that the tests import.
    options = ("--no-deps", "--no-index", "--ignore-installed", "--prefix", environment)
    output_of(tmp_path, *pip, "install", *options, wheel)
    python, script = environment / "bin" / "python", environment / "bin" / "rgbt"
    script.write_text(f"#!{python}\n" + script.read_text().partition("\n")[2])
    code = "import rgbt, sweeps, analysis; print(rgbt.__file__, sweeps.__file__, analysis.__file__)"
    shown = output_of(folder, python, "-c", code)
    assert all(path.startswith(str(environment)) for path in shown.split()), shown
    assert output_of(folder, script, "--version") == f"rgbt {rgbt.__version__}\n"
    words = ("+debug=smoke", "trainer.accelerator=cpu", "trainer.threads=1")
    assert "mIoU" in output_of(folder, script, "run", "+experiment=grbm", *words)
    assert "crm/table1" in output_of(
        folder, script, "reproduce", "table=crm/table1", "dry_run=true"
    )
    output_of(folder, script, "report", "out=report")
    page = (folder / "report" / "index.html").read_text()
    assert all(f"{paper}: " in page for paper in ("crm", "multihead", "spatialseg", "temporal"))
    output_of(folder, script, "figures")
    # The points of a grid are processes of their own.
    grid = ("-m", "+experiment=mfnet", "seed=0,1", "tracking=none")
    output_of(folder, script, "run", *grid, *words)
    assert len(list((folder / "runs").glob("*/result.json"))) == 3
