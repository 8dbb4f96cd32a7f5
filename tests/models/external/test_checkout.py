"""Checkouts are imported apart from each other, and nothing of them is left behind."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from rgbt.checks import InputError
from rgbt.models.external.checkout import Checkout
from tests.models.external.standins import STACKED, external, images, write_checkout


@pytest.fixture(autouse=True)
def nothing_left() -> object:
    """Every test leaves ``sys.path`` and the modules of other files as they were."""
    path, modules = list(sys.path), set(sys.modules)
    yield
    left = {name for name in set(sys.modules) - modules if not name.startswith(("rgbt", "torch"))}
    assert sys.path == path
    assert not left & {"model", "model.net", "models", "toolbox", "resnet", "absent", "util"}


def test_two_checkouts_with_the_same_package_live_in_one_process(tmp_path: Path) -> None:
    first = write_checkout(tmp_path / "a", {"model/__init__.py": "", "model/net.py": STACKED})
    other = STACKED.replace("self.conv(x)", "self.conv(x) + OFFSET").replace(
        "import torch\n", "import torch\nfrom model.util import OFFSET\n", 1
    )
    second = write_checkout(tmp_path / "b", {"model/net.py": other, "model/util.py": "OFFSET = 5"})
    one, two = external(first).eval(), external(second).eval()
    two.load_state_dict(one.state_dict())
    pair = images()
    torch.testing.assert_close(two(*pair).logits, one(*pair).logits + 5)
    assert type(one.network) is not type(two.network)
    again = external(first)  # the classes of the first import
    assert type(again.network) is type(one.network)


def test_namespace_packages_and_lazy_imports_are_taken_out(tmp_path: Path) -> None:
    lazy = STACKED.replace(
        "super().__init__()", "super().__init__()\n        from model.deep.part import VALUE"
    )
    folder = write_checkout(tmp_path, {"model/net.py": lazy, "model/deep/part.py": "VALUE = 1"})
    external(folder)
    assert "model.deep.part" not in sys.modules
    external(folder)  # found again although its modules are gone


def test_a_module_of_the_same_name_is_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = ModuleType("model")
    monkeypatch.setitem(sys.modules, "model", mine)
    external(write_checkout(tmp_path, {"model/net.py": STACKED}))
    assert sys.modules["model"] is mine
    assert "model.net" not in sys.modules


def test_a_failed_import_leaves_nothing_behind(tmp_path: Path) -> None:
    broken = "import model.util\nimport not_a_package_of_anyone\n"
    folder = write_checkout(tmp_path, {"model/net.py": broken, "model/util.py": ""})
    for _ in range(2):
        with pytest.raises(InputError, match="'not_a_package_of_anyone', which is neither") as info:
            external(folder)
        assert "\n" not in str(info.value)
        assert not [name for name in sys.modules if name.partition(".")[0] == "model"]


def test_empty_packages_do_not_execute_their_init(tmp_path: Path) -> None:
    files = {"toolbox/__init__.py": "from .optim import Ranger", "toolbox/models/Net.py": STACKED}
    folder = write_checkout(tmp_path, files)
    named = {"constructor": "toolbox.models.Net:Net"}
    with pytest.raises(InputError, match=r"'toolbox\.optim', which is neither"):
        external(folder, **named)
    net = external(folder, **named, empty_packages=("toolbox",))
    assert net.eval()(*images()).logits.shape == (2, 3, 8, 12)
    with pytest.raises(InputError, match="has no package 'other'"):
        external(folder, **named, empty_packages=("other",))


def test_stubs_replace_packages_that_are_not_installed(tmp_path: Path) -> None:
    code = """
import absent.tools as tools
from absent.registry import ARCH
from absent.registry import twice
from importlib.util import find_spec
assert find_spec("absent") is not None
"""
    wrapped = STACKED.replace("class Net", "@ARCH.register()\nclass Net")
    folder = write_checkout(tmp_path, {"model/net.py": code + wrapped})
    stubs = {"absent.tools": {}, "absent.registry": {"twice": "operator:neg"}}
    assert external(folder, stubs=stubs).eval()(*images()).logits.shape == (2, 3, 8, 12)
    with pytest.raises(InputError, match="cannot import 'operator:nothing'"):
        external(folder, stubs={"absent.registry": {"twice": "operator:nothing"}})


def test_a_stub_does_not_replace_an_installed_package(tmp_path: Path) -> None:
    code = "import numpy as np\nassert np.ones(2).sum() == 2\n" + STACKED
    network = external(write_checkout(tmp_path, {"model/net.py": code}), stubs={"numpy": {}})
    assert network.eval()(*images()).logits.shape == (2, 3, 8, 12)


def test_a_stub_replaces_a_module_that_an_installed_package_lacks(tmp_path: Path) -> None:
    code = "from numpy.lib.gone.inner import delete\nimport numpy\nnumpy.ones(2)\n" + STACKED
    external(write_checkout(tmp_path, {"model/net.py": code}), stubs={"numpy.lib.gone.inner": {}})
    assert "numpy.lib.gone" not in sys.modules


@pytest.mark.parametrize("empty", [(), ("model",)])
def test_a_stub_inside_the_checkout_keeps_its_package(
    tmp_path: Path, empty: tuple[str, ...]
) -> None:
    code = "import model.ops.compiled\nfrom model.ops.size import SIZE\nassert SIZE == 2\n"
    files = {"model/net.py": code + STACKED, "model/ops/size.py": "SIZE = 2"}
    stubs = {"model.ops.compiled": {}}
    external(write_checkout(tmp_path, files), stubs=stubs, empty_packages=empty)
    assert not any(name.partition(".")[0] == "model" for name in sys.modules)


def test_prints_and_log_handlers_are_dropped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = "import logging\nlogging.getLogger().addHandler(logging.StreamHandler())\nprint('hi')\n"
    handlers = list(logging.getLogger().handlers)
    external(write_checkout(tmp_path, {"model/net.py": code + STACKED}))
    assert logging.getLogger().handlers == handlers
    assert capsys.readouterr() == ("", "")
    assert not list(tmp_path.rglob("__pycache__"))


def test_checkout_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"model\.checkout=.*the folder .* does not exist"):
        external(tmp_path / "nowhere")
    write_checkout(tmp_path, {"model/net.py": STACKED})
    with pytest.raises(InputError, match="elsewhere does not exist"):
        external(tmp_path, root="elsewhere")
    assert Checkout.at(str(tmp_path), ".", (), {}).names == {"model"}


@pytest.mark.parametrize("root", ["../evil", "link", "{}/evil"])
def test_a_root_outside_of_the_checkout_is_not_executed(tmp_path: Path, root: str) -> None:
    executed = tmp_path / "executed"
    marked = f"open({str(executed)!r}, 'w')\n{STACKED}"
    write_checkout(tmp_path / "evil", {"model/net.py": marked})
    folder = write_checkout(
        tmp_path / "code", {"model/net.py": STACKED, "src/model/net.py": STACKED}
    )
    (folder / "link").symlink_to(tmp_path / "evil")
    with pytest.raises(InputError, match="leads out of model.checkout=.*code; name a folder in it"):
        external(folder, root=root.format(tmp_path))
    assert not executed.exists()
    external(folder, root="src")
