"""Classes of checkouts are found and called; every mistake is one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rgbt.checks import InputError
from rgbt.models.external.building import namespace
from tests.models.external.standins import HEAD, STACKED, external, images, write_checkout

NAMESPACE = f"""{HEAD}
class Net(Base):
    def __init__(self, cfg=None, norm_layer=nn.BatchNorm2d):
        super().__init__(cfg.num_classes if "num_classes" in cfg else cfg["k"])
        self.names = [each for each in cfg.modals], cfg.deep.eps
    def forward(self, x):
        return self.conv(x)
"""


def test_namespaces_have_attributes_and_keys(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": NAMESPACE})
    cfg = {"num_classes": 3, "modals": ["img", "thermal"], "deep": {"eps": 1e-3}}
    net = external(folder, arguments={}, namespaces={"cfg": cfg})
    assert net.network.names == (["img", "thermal"], 1e-3)
    del cfg["deep"]
    with pytest.raises(InputError, match="the namespace has no value 'deep'"):
        external(folder, arguments={}, namespaces={"cfg": cfg})
    assert not hasattr(namespace({"a": 1}), "b")


HOLLOW = """
def hollow(n_class):
    return Net(n_class).to("meta")
"""


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"constructor": "model.nets:Net"},
            r"the module model\.nets is not in the checkout .*root",
        ),
        ({"constructor": "model.net:Nett"}, r"has no class or function 'Nett'; .*'Net'\?"),
        ({"constructor": "os:system"}, "the module os is not in the checkout"),
        ({"constructor": "model.net:build", "arguments": {}}, "returned int 3; expected a torch"),
        ({"arguments": {"classes": 3}}, r"takes \(n_class, channels=4\), but got classes"),
        ({"arguments": {}}, "missing a required argument: 'n_class'"),
        ({"arguments": {"n_class": "x"}}, r"cannot be built: TypeError: .*model/net.py, line 8"),
        ({"constructor": "model.stops:Net"}, "cannot be imported: SystemExit: 2"),
        ({"constructor": "model.net:hollow"}, r"builds parameters without values \(device meta"),
        ({"constructor": "model.wrong:Net"}, r"cannot be imported: SyntaxError: .*"),
        ({"constructor": "model.scans:Net"}, r"'scan_cuda'.* compiled for CUDA: .* its sources"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path: Path, changes: dict[str, object], reason: str) -> None:
    folder = write_checkout(
        tmp_path,
        {
            "model/__init__.py": "",
            "model/net.py": f"{STACKED}\ndef build():\n    return 3\n{HOLLOW}",
            "model/stops.py": "raise SystemExit(2)",
            "model/wrong.py": "def",
            "model/scans.py": "import scan_cuda",
        },
    )
    with pytest.raises(InputError, match=reason) as info:
        external(folder, **changes)
    assert "\n" not in str(info.value)


CUDA = STACKED.replace(
    "super().__init__()", "super().__init__()\n        self.index = torch.tensor([1.5]).cuda()"
).replace("return self.conv(x)", "return self.conv(x) + torch.ones(1).cuda() * self.index")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there the calls are no mistake")
def test_cuda_calls_need_a_gpu_or_are_moved(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": CUDA})
    with pytest.raises(InputError, match=r"requires CUDA: .* model\.moves_cuda=true"):
        external(folder)
    net = external(folder, moves_cuda=True).eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
    assert torch.equal(net(*images()).logits, torch.full((2, 3, 8, 12), 1.5))
    with pytest.raises((AssertionError, RuntimeError), match="CUDA|NVIDIA"):
        torch.ones(1).cuda()


def test_plain_tensors_of_modules_move_with_the_network(tmp_path: Path) -> None:
    net = external(write_checkout(tmp_path, {"model/net.py": CUDA}), moves_cuda=True)
    assert net.double().network.index.dtype == torch.float64


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
