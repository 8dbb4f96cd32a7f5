"""Networks of checkouts: built, adapted, fed, and their scores found; mistakes name the setting."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt.checkpoints.load import load_weights
from rgbt.checks import InputError
from rgbt.exported.onnx_network import exported_network
from rgbt.files.adapters import adapter_of
from rgbt.models.external.adapting import Untrained, replaced
from rgbt.models.external.network import edge_map, picked, scores_at, structure
from rgbt.requirements import NetworkRecord, record_of
from tests.models.external.standins import (
    HEAD,
    PAIR,
    STACKED,
    external,
    forget,
    images,
    own_process,  # noqa: F401 - used by every test
    write_checkout,
)

# ---- building ----
NAMESPACE = f"""{HEAD}
class Net(Base):
    def __init__(self, cfg=None, norm_layer=nn.BatchNorm2d):
        super().__init__(cfg.num_classes if "num_classes" in cfg else cfg["k"])
        self.names = [modal for modal in cfg.modals], cfg.deep.eps
"""


def test_namespaces_have_attributes_and_keys(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": NAMESPACE})
    cfg = {"num_classes": 3, "modals": ["img", "thermal"], "deep": {"eps": 1e-3}}
    net = external(folder, arguments={}, namespaces={"cfg": cfg})
    assert net.network.names == (["img", "thermal"], 1e-3)
    del cfg["deep"]
    with pytest.raises(InputError, match="the namespace has no value 'deep'"):
        external(folder, arguments={}, namespaces={"cfg": cfg})


def test_second_checkout_of_a_process_is_refused(tmp_path: Path) -> None:
    first = external(write_checkout(tmp_path / "a", {"model/net.py": STACKED}))
    again = external(tmp_path / "a")
    assert type(again.network) is type(first.network)
    other = write_checkout(tmp_path / "b", {"model/net.py": STACKED})
    with pytest.raises(InputError, match="use another process"):
        external(other)


def test_module_of_other_folder_is_not_the_checkouts(tmp_path: Path) -> None:
    mine = ModuleType("model.net")
    mine.Net = torch.nn.Identity  # type: ignore[attr-defined]
    sys.modules["model.net"] = mine
    with pytest.raises(InputError, match=r"model\.net is not a module of"):
        external(write_checkout(tmp_path, {"model/net.py": STACKED}))


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


def test_stand_in_is_for_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package is itself; what no stand-in has is named with the line of its import."""
    monkeypatch.setenv("RGBT_CONF", f"{tmp_path / 'none'},{tmp_path / 'conf'}")
    write_checkout(tmp_path / "conf/model/external", {"odd.py": ADAPTER.replace("allow_cpu()", "")})
    code = ODD.replace(".cuda()", "") + "\nimport absent.models\n"
    folder = write_checkout(tmp_path / "code", {"toolbox/net.py": code})
    line = 1 + code.splitlines().index("import absent.models")
    with pytest.raises(InputError, match=rf"'absent\.models'.*code/toolbox/net\.py line {line}\."):
        external(folder, constructor="odd.py:network")
    registry = """
from unittest.mock import MagicMock
ARCH = MagicMock()
def twice(value):
    return 2 * value + 1
"""
    empty = dict.fromkeys(("absent/__init__.py", "absent/tools.py", "absent/models.py"), "")
    installed = write_checkout(tmp_path / "site", {**empty, "absent/registry.py": registry})
    monkeypatch.syspath_prepend(installed)
    forget()
    assert external(folder, constructor="odd.py:network").network.two == 3


def test_untrained_functions_ignore_pretrained() -> None:
    module = ModuleType("zoo")
    module.build = lambda depth, pretrained=False: (depth, pretrained)  # type: ignore[attr-defined]
    assert Untrained(module).build(18, pretrained=True) == (18, False)
    changed = replaced(module, build=1)
    assert (changed.build, module.build(2)) == (1, (2, False))  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["../odd.py", "../external/odd.py", "{}/odd.py", "none.py"])
def test_adapter_lies_beside_a_recipe(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = name.format(tmp_path)
    recipes = tmp_path / "conf/model/external"
    write_checkout(recipes, {"odd.py": "", "../odd.py": ""})
    write_checkout(tmp_path, {"odd.py": ""})
    monkeypatch.setenv("RGBT_CONF", f"{tmp_path / 'none'}, file://{tmp_path / 'conf'}")
    assert adapter_of("model.net:Net") is None
    assert adapter_of("odd.py:network") == recipes / "odd.py"
    ours = adapter_of("adapters.py:network")
    assert ours is not None
    assert ours.is_file()
    with pytest.raises(FileNotFoundError):
        adapter_of(f"{name}:network")


# ---- calling ----
LIST = PAIR.replace("def forward(self, rgb, thermal):", "def forward(self, x):").replace(
    "both = torch.cat([rgb, thermal[:, :1]], 1)", "both = torch.cat([x[0], x[1][:, :1]], 1)"
)
DICTS = f"""{HEAD}
class Net(Base):
    def forward(self, batched):
        return [{{"sem_seg": self.conv(image["image"])}} for image in batched]
"""
THERMAL = STACKED.replace("channels=4", "channels=1")
EDGES = f"""{HEAD}
class Net(Base):
    def forward(self, rgb, thermal, label):
        assert label.shape == (len(rgb), *rgb.shape[2:])
        return self.conv(torch.cat([rgb, label[:, None] / 255], 1))
"""
TWO = ((0,),)


@pytest.mark.parametrize(
    ("code", "changes", "inputs"),
    [
        (STACKED, {}, "unit"),
        (STACKED.replace("channels=4", "channels=6"), {}, "unit_three"),
        (PAIR, {"feed": "pair", "scores": TWO}, "imagenet_449"),
        (LIST, {"feed": "list", "scores": TWO}, "imagenet_unit"),
        (DICTS, {"feed": "dicts", "scores": (("*", "sem_seg"),)}, "crm"),
        (THERMAL, {"feed": "thermal"}, "unit"),
        (EDGES, {"feed": "pair_and_edges"}, "unit_three"),
    ],
)
def test_every_form_is_fed_with_normalised_images(
    tmp_path: Path, code: str, changes: dict[str, Any], inputs: str
) -> None:
    net = external(write_checkout(tmp_path, {"model/net.py": code}), inputs=inputs, **changes)
    rgb, thermal = images()
    shown = net.inputs(rgb, thermal)
    seen = {
        "thermal": [shown.thermal],
        "pair_and_edges": [shown.rgb, edge_map(rgb, thermal) / 255],
    }.get(net.feed, [shown.rgb, shown.thermal[:, :1] if code in (PAIR, LIST) else shown.thermal])
    expected = net.network.conv(torch.cat(seen, 1))
    torch.testing.assert_close(net.eval()(rgb, thermal).logits, expected)
    assert net.record.views == (("thermal",) if net.feed == "thermal" else ("rgbt",))


def test_edge_map_is_that_of_opencv() -> None:
    """The same arithmetic with OpenCV's operators on bytes, whose sum wraps."""
    rng = np.random.default_rng(0)
    grey, thermal = rng.integers(0, 256, (2, 9, 11), dtype=np.uint8)
    halves = []
    for image in (grey, thermal):
        across, down = (
            cv2.convertScaleAbs(cv2.Sobel(image, cv2.CV_16S, *order)) for order in ((1, 0), (0, 1))
        )
        halves.append(cv2.addWeighted(across, 0.5, down, 0.5, 0))
    rgb = torch.tensor(grey / 255).expand(1, 3, 9, 11)
    found = edge_map(rgb, torch.tensor(thermal / 255)[None, None])
    np.testing.assert_array_equal(found[0, 0], halves[0] + halves[1])
    assert (halves[0].astype(int) + halves[1] > 255).any()


def test_paths_lead_through_lists_keys_attributes_and_elements() -> None:
    output = [1, {"out": SimpleNamespace(scores=(2, 3))}, [{"a": torch.ones(2)}] * 4]
    assert picked(output, ()) is output
    assert picked(output, (1, "out", "scores", -1)) == 3
    assert picked(output, (2, "*", "a")).shape == (4, 2)
    assert [picked(output, path) for path in ((7,), (1, "in"), (0, 0))] == [None] * 3
    words = "list (int 1, tuple (int 2, float 3.0), None, str 'a')"
    assert structure([1, (2, 3.0), None, "a"]) == words


def test_scores_of_paths_are_added_and_others_refused() -> None:
    scores = torch.ones(2, 3, 4, 5)
    found = scores_at((scores, [2 * scores]), ((0,), (1, 0)), "model.scores", (2, 3))
    assert torch.equal(found, 3 * scores)
    others = (([scores], (3,)), ((scores, 1), ()), (scores[:1], ()), (scores.long(), ()))
    for output, path in (*others, (scores, (0,)), (scores[:, :2], ())):
        with pytest.raises(InputError, match=r"^model.scores: expected scores \(2, 3, h, w\)"):
            scores_at(output, (path,), "model.scores", (2, 3))


STRIDED = STACKED.replace(
    "return self.conv(x)",
    "assert x.shape[2] % 4 == 0 == x.shape[3] % 4\n        return self.conv(x)[..., ::4, ::4]",
)


def test_forward_scores_every_pixel_also_of_odd_sides(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": STRIDED})
    net = external(folder, multiple=4, resize=True)
    for training in (False, True):
        out = net.train(training)(*images(2, 9, 13), generator=torch.Generator())
        assert (out.logits.shape, out.aux) == ((2, 3, 9, 13), {})
        assert out.logits.dtype == torch.float32
    exported = exported_network(net.eval(), "rgbt", (9, 13), "strided")
    torch.testing.assert_close(*(model(*images(2, 9, 13)).logits for model in (exported, net)))
    with pytest.raises(InputError, match=r"model\.scores: .* scores of \(3, 4\) .* \(12, 16\)"):
        external(folder, multiple=4).eval()(*images(2, 9, 13))


def test_scores_are_enlarged_between_the_centres_of_their_pixels(tmp_path: Path) -> None:
    """Two pixels, four times as fine: the values 0 and 1 are 0, 1/4, 3/4, 1."""
    ramp = "torch.tensor([[0.0, 1], [2, 3]]).expand(len(x), 3, 2, 2)"
    scores = STACKED.replace("self.conv(x)", f"0 * self.conv(x).mean() + {ramp}")
    net = external(write_checkout(tmp_path, {"model/net.py": scores}), resize=True).eval()
    axis = torch.tensor([0, 0.25, 0.75, 1])
    expected = (2 * axis[:, None] + axis).expand(2, 3, 4, 4)
    torch.testing.assert_close(net(*images(2, 4, 4)).logits, expected)


def test_edges_are_padded_and_resized_as_the_images(tmp_path: Path) -> None:
    sizes = EDGES.replace("return", "assert rgb.shape[2:] == (16, 24)\n        return")
    folder = write_checkout(tmp_path, {"model/net.py": sizes})
    for changes in ({"multiple": 8}, {"size_hw": (16, 24)}):
        net = external(folder, inputs="unit_three", feed="pair_and_edges", **changes).eval()
        assert net(*images(2, 10, 20)).logits.shape == (2, 3, 10, 20)


def test_images_that_mix_are_passed_one_by_one(tmp_path: Path) -> None:
    mixing = STACKED.replace("self.conv(x)", "self.conv(x) + x.mean()")
    folder = write_checkout(tmp_path, {"model/net.py": mixing})
    rgb, thermal = images(3)
    for one_by_one in (False, True):
        net = external(folder, one_by_one=one_by_one).eval()
        alone = torch.cat([net(rgb[n : n + 1], thermal[n : n + 1]).logits for n in range(3)])
        assert torch.equal(net(rgb, thermal).logits, alone) == one_by_one


DRAWS = "import numpy as np\nimport random\n" + STACKED.replace(
    "return self.conv(x)",
    "noise = torch.rand(1) + float(np.random.rand()) + random.random()\n"
    "        return self.conv(x) + noise",
)


def test_draws_come_from_the_generator_and_leave_no_trace(tmp_path: Path) -> None:
    net = external(write_checkout(tmp_path, {"model/net.py": DRAWS}))
    pair = images()
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()
    first, again, other = (
        net.train()(*pair, generator=torch.Generator().manual_seed(n)).logits for n in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.allclose(first, other)
    assert torch.equal(net.eval()(*pair).logits, net(*pair).logits)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()
    assert random.getstate() == before[2]


def test_training_may_read_other_scores(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": PAIR})
    chosen: dict[str, Any] = {"scores": TWO, "train_scores": ((1,), (1,)), "auxiliary": (0,)}
    net = external(folder, feed="pair", **chosen)
    evaluated = net.eval()(*images())
    trained = net.train()(*images(), generator=torch.Generator())
    assert evaluated.aux == {}
    torch.testing.assert_close(trained.logits, -2 * evaluated.logits)
    torch.testing.assert_close(trained.aux["aux_logits"], evaluated.logits)
    record = record_of(net, NetworkRecord)
    assert record.auxiliary
    assert [(need.node, need.key) for need in record.requires] == [("loss", "reads_auxiliary")]


@pytest.mark.parametrize("names", ["{}", "module.{}", "net.{}", "network.{}"])
def test_weights_of_the_author_are_loaded(tmp_path: Path, names: str) -> None:
    """ "network." is before the names of this project's own files."""
    folder = write_checkout(tmp_path / "code", {"model/net.py": STACKED})
    state = {"conv.weight": torch.ones(3, 4, 1, 1), "conv.bias": torch.zeros(3)}
    named = {names.format(key): value for key, value in state.items()}
    torch.save({"state_dict": named, "epoch_start": 3}, tmp_path / "author.pth")
    net = external(folder, weights_prefix="net." if names == "net.{}" else "")
    load_weights(net, tmp_path / "author.pth")
    assert bool((net.network.conv.weight == 1).all())
    assert not net.network.conv.bias.any()
