"""Networks of checkouts are built, directly or by adapters; each mistake names its setting."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from rgbt.checks import InputError
from rgbt.files.adapters import adapter_of
from rgbt.models.external.adapting import Untrained, replaced
from tests.models.external.standins import (
    HEAD,
    STACKED,
    external,
    images,
    own_process,  # noqa: F401 - used by every test
    write_checkout,
)

NAMESPACE = f"""{HEAD}
class Net(Base):
    def __init__(self, cfg=None, norm_layer=nn.BatchNorm2d):
        super().__init__(cfg.num_classes if "num_classes" in cfg else cfg["k"])
        self.names = [each for each in cfg.modals], cfg.deep.eps
"""


def test_namespaces_have_attributes_and_keys(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": NAMESPACE})
    cfg = {"num_classes": 3, "modals": ["img", "thermal"], "deep": {"eps": 1e-3}}
    net = external(folder, arguments={}, namespaces={"cfg": cfg})
    assert net.network.names == (["img", "thermal"], 1e-3)
    del cfg["deep"]
    with pytest.raises(InputError, match="the namespace has no value 'deep'"):
        external(folder, arguments={}, namespaces={"cfg": cfg})


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"constructor": "model.nets:Net"}, r"constructor=model.nets:Net: ModuleNotFoundError"),
        ({"constructor": "model.net:Nett"}, "constructor=model.net:Nett: AttributeError"),
        ({"constructor": "os:system"}, "constructor=os:system: os is not a module of"),
        ({"constructor": "none.py:network"}, "constructor=none.py:network: FileNotFoundError"),
        (
            {"constructor": "model.net:build", "arguments": {}},
            "constructor=model.net:build returned int 3",
        ),
        ({"arguments": {"classes": 3}}, "constructor=.*unexpected keyword argument 'classes'"),
        ({"constructor": "model.stops:Net"}, "constructor=model.stops:Net: SystemExit: 2"),
        ({"root": "nowhere"}, "checkout: no such folder: .*nowhere"),
        ({"root": "../evil"}, "root=../evil leads out of model.checkout="),
        ({"root": "link"}, "root=link leads out of model.checkout="),
    ],
)
def test_mistake_names_its_setting(tmp_path: Path, changes: dict[str, object], key: str) -> None:
    files = {"model/net.py": f"{STACKED}\ndef build():\n    return 3\n"}
    folder = write_checkout(tmp_path / "code", {**files, "model/stops.py": "raise SystemExit(2)"})
    evil = write_checkout(tmp_path / "evil", {"model/net.py": "raise KeyboardInterrupt"})
    (folder / "link").symlink_to(evil)
    with pytest.raises(InputError, match=rf"^model\.{key}"):
        external(folder, **changes)


def test_second_checkout_of_a_process_is_refused(tmp_path: Path) -> None:
    first = external(write_checkout(tmp_path / "a", {"model/net.py": STACKED}))
    again = external(tmp_path / "a")
    assert type(again.network) is type(first.network)
    other = write_checkout(tmp_path / "b", {"model/net.py": STACKED})
    with pytest.raises(InputError, match="use another process"):
        external(other)


def test_module_of_another_folder_is_not_taken_for_the_checkouts(tmp_path: Path) -> None:
    mine = ModuleType("model.net")
    mine.Net = torch.nn.Identity  # type: ignore[attr-defined]
    sys.modules["model.net"] = mine
    with pytest.raises(InputError, match=r"model\.net is not a module of"):
        external(write_checkout(tmp_path, {"model/net.py": STACKED}))


def test_network_may_import_when_it_is_called(tmp_path: Path) -> None:
    lazy = STACKED.replace("return", "from model.late import TWO\n        return TWO *")
    files = {"model/net.py": lazy, "model/late.py": "TWO = 2", "json.py": "raise SystemExit"}
    net = external(write_checkout(tmp_path, files)).eval()
    rgb, thermal = images()
    expected = 2 * net.network.conv(torch.cat([rgb, thermal], 1))
    torch.testing.assert_close(net(rgb, thermal).logits, expected)
    assert sys.path[-1] == str(tmp_path)  # nothing of ours is looked for there first


def test_weights_follow_the_generator_also_of_numpy(tmp_path: Path) -> None:
    code = "import numpy as np\nimport random\n" + STACKED.replace(
        "super().__init__()",
        "super().__init__()\n        self.drawn = np.random.rand(), random.random()",
    )
    folder = write_checkout(tmp_path, {"model/net.py": code})

    def built(seed: int) -> tuple[object, torch.Tensor]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = external(folder).network
        return network.drawn, network.conv.weight

    (first, weight), (again, same), (other, _) = built(0), built(0), built(1)
    assert first == again != other
    assert torch.equal(weight, same)


# ---- adapters -------------------------------------------------------------------------------

ODD = f"""
import absent.tools as tools
from absent.registry import ARCH, twice
{HEAD}
@ARCH.register()
class Unused(nn.Module):
    pass

class Net(Base):
    def __init__(self, n_class):
        super().__init__(n_class)
        self.two = twice(1)
        self.load_state_dict(torch.load("/home/author/pretrained.pth"), strict=False)
        self.index = torch.tensor([1.5]).cuda()

    def forward(self, x):
        return self.conv(x) + self.index
"""
ADAPTER = """
import torch
from rgbt.models.external.adapting import allow_cpu, replace_in, replaced, skip_init, stand_in


def network(n_class):
    skip_init("toolbox")
    stand_in("absent.tools")
    stand_in("absent.registry", twice=lambda value: 2 * value)
    allow_cpu()
    from toolbox.net import Net

    replace_in(Net, torch=replaced(torch, load=lambda _: {}))
    return Net(n_class)
"""


@pytest.mark.skipif(torch.cuda.is_available(), reason="`.cuda()` is no mistake there")
def test_adapter_builds_an_odd_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (torch.Tensor, torch.nn.Module):
        monkeypatch.setattr(kind, "cuda", kind.cuda)  # restored after the test
    monkeypatch.setenv("RGBT_CONF", f"{tmp_path / 'none'},{tmp_path / 'conf'}")
    write_checkout(tmp_path / "conf/model/external", {"odd.py": ADAPTER})
    files = {"toolbox/__init__.py": "raise SystemExit", "toolbox/net.py": ODD}
    folder = write_checkout(tmp_path / "code", files)
    load = torch.load
    for _ in range(2):
        net = external(folder, constructor="odd.py:network").eval()
    rgb, thermal = images()
    expected = net.network.conv(torch.cat([rgb, thermal], 1)) + 1.5
    torch.testing.assert_close(net(rgb, thermal).logits, expected)
    assert net.network.two == 2
    assert torch.load is load


def test_untrained_functions_ignore_pretrained() -> None:
    module = ModuleType("zoo")
    module.build = lambda depth, pretrained=False: (depth, pretrained)  # type: ignore[attr-defined]
    assert Untrained(module).build(18, pretrained=True) == (18, False)
    changed = replaced(module, build=1)
    assert (changed.build, module.build(2)) == (1, (2, False))  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["../external/gmnet.py", "/tmp/gmnet.py", "none.py"])  # noqa: S108
def test_adapter_lies_beside_a_recipe(name: str) -> None:
    assert adapter_of("model.net:Net") is None
    found = adapter_of("gmnet.py:network")
    assert found is not None
    assert found.with_suffix(".yaml").is_file()
    with pytest.raises(FileNotFoundError):
        adapter_of(f"{name}:network")
