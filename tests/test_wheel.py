"""An installed wheel carries everything: commands run in an empty folder without this checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

import rgbt

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("rgbt", "sweeps", "analysis", "hydra_plugins", "conf")
SOURCES = (*PACKAGES, "pyproject.toml", "README.md", "LICENSE")

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Installed:
    """An environment with the wheel, and an empty folder to work in."""

    wheel: Path
    python: Path
    folder: Path

    def run(self, *words: str, code: int = 0) -> str:
        """What ``rgbt`` with these words prints."""
        command = [str(self.python.with_name("rgbt")), *words]
        return _run(command, self.folder, code)


def _run(command: list[str], folder: Path, code: int = 0) -> str:
    hidden = ("PYTHONPATH", "RGBT_CONF", "RGBT_SHARED")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel, built offline from a copy and installed where our dependencies are found."""
    place = tmp_path_factory.mktemp("wheel")
    copy = place / "source"
    for name in SOURCES:
        source = ROOT / name
        copier = shutil.copytree if source.is_dir() else shutil.copy
        copy.mkdir(exist_ok=True)
        copier(source, copy / name)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    _run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(place), str(copy)], place)
    (wheel,) = place.glob("*.whl")
    environment, folder = place / "env", place / "empty"
    folder.mkdir()
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    # The dependencies of this environment, without its own rgbt: *.pth files are not read there.
    (site,) = (environment / "lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install = ["install", "--no-deps", "--no-index", "--force-reinstall", "--prefix"]
    _run([*pip, *install, str(environment), str(wheel)], place)
    shebang = f"#!{python}\n"
    script = environment / "bin" / "rgbt"
    script.write_text(shebang + script.read_text().partition("\n")[2])
    return Installed(wheel, python, folder)


def test_wheel_holds_every_file_of_the_repository(installed: Installed) -> None:
    tracked = _run(["git", "-C", str(ROOT), "ls-files", *PACKAGES], ROOT).split()
    expected = {
        name.replace("conf/", "rgbt/conf/", 1) if name[:5] == "conf/" else name for name in tracked
    }
    with zipfile.ZipFile(installed.wheel) as archive:
        carried = {name for name in archive.namelist() if ".dist-info/" not in name}
    present = {
        name for name in expected if (ROOT / name.replace("rgbt/conf/", "conf/", 1)).is_file()
    }
    assert present - carried == set()
    extra = {name for name in carried - present if not name.endswith(".py")}
    assert extra == set(), "files of the wheel that the repository does not track"


def test_installed_package_is_not_this_repository(installed: Installed) -> None:
    code = "import rgbt, sweeps, analysis; print(rgbt.__file__, sweeps.__file__, analysis.__file__)"
    shown = _run([str(installed.python), "-c", code], installed.folder)
    assert all(path.startswith(str(installed.python.parents[1])) for path in shown.split()), shown


def test_version_is_the_one_of_the_package(installed: Installed) -> None:
    assert installed.run("--version") == f"rgbt {rgbt.__version__}\n"
    assert f"rgbt-{rgbt.__version__}-" in installed.wheel.name


def test_installed_commands_run_in_an_empty_folder(installed: Installed) -> None:
    words = ("trainer.accelerator=cpu", "trainer.threads=1")
    shown = installed.run("run", "+experiment=grbm", "+debug=smoke", *words)
    assert "mIoU" in shown
    (result,) = (installed.folder / "runs").glob("*/result.json")
    assert "crm/table1" in installed.run("reproduce", "table=crm/table1", "dry_run=true")
    installed.run("report", "out=report")
    assert (installed.folder / "report" / "index.html").stat().st_size > 100_000
    installed.run("figures")
    # The points of a grid are processes of their own.
    grid = ("-m", "+experiment=mfnet", "+debug=smoke", "seed=0,1", "tracking=none", *words)
    installed.run("run", *grid)
    assert len(list((installed.folder / "runs").glob("*/result.json"))) == 3
    assert result.is_file()
