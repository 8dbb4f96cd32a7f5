"""The network of an author behaves as every network of this project."""

from __future__ import annotations

import copy
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.checkpoints.load import load_weights
from rgbt.checks import InputError
from rgbt.requirements import record_of
from rgbt.types import MaskPair
from tests.models.external.standins import (
    PAIR,
    STACKED,
    external,
    generator,
    images,
    write_checkout,
)

DRAWS = "import numpy as np\nimport random\n" + STACKED.replace(
    "return self.conv(x)",
    "noise = torch.rand(1) + float(np.random.rand()) + random.random()\n"
    "        return self.conv(x) + noise",
)
STRIDED = STACKED.replace(
    "return self.conv(x)",
    "assert x.shape[2] % 4 == 0 == x.shape[3] % 4, 'sides of 4'\n"
    "        return self.conv(x)[..., ::4, ::4]",
)
MIXING = STACKED.replace("self.conv(x)", "self.conv(x) + x.mean()")


def test_forward_returns_scores_of_every_pixel_also_of_odd_sides(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": STRIDED})
    net = external(folder, multiple=4, resize=True)
    for training in (False, True):
        out = net.train(training)(*images(2, 9, 13), generator=generator())
        assert (out.logits.shape, out.aux) == ((2, 3, 9, 13), {})
        assert out.logits.dtype == torch.float32
    with pytest.raises(InputError, match=r"scores of 3 x 4 for images of 12 x 16 pixels; set"):
        external(folder, multiple=4).eval()(*images(2, 9, 13))
    with pytest.raises(InputError, match="9 x 13 pixels .* AssertionError: sides of 4 .*, line"):
        external(folder, resize=True).eval()(*images(2, 9, 13))


def test_exact_sizes_resize_images_and_scores(tmp_path: Path) -> None:
    exact = STACKED.replace("return", "assert x.shape[2:] == (16, 24)\n        return")
    net = external(write_checkout(tmp_path, {"model/net.py": exact}), size_hw=(16, 24)).eval()
    rgb, thermal = images()
    shown = torch.nn.functional.interpolate(
        torch.cat([rgb, thermal], 1), size=(16, 24), mode="bilinear"
    )
    expected = torch.nn.functional.interpolate(
        net.network.conv(shown), size=(8, 12), mode="bilinear"
    )
    torch.testing.assert_close(net(rgb, thermal).logits, expected)
    with pytest.raises(InputError, match=r"model\.multiple=4 has no effect with model\.size_hw"):
        external(tmp_path, size_hw=(16, 24), multiple=4)


def test_hidden_pixels_do_not_count(tmp_path: Path) -> None:
    net = external(write_checkout(tmp_path, {"model/net.py": STACKED}), multiple=32).eval()
    hidden = torch.zeros(1, 2, 2, dtype=torch.bool)
    hidden[0, 1, 1] = True
    rgb, thermal = images(1, 40, 50)
    other = rgb.clone()
    other[..., 32:, 32:] = 0.5
    masks = MaskPair(hidden, torch.zeros_like(hidden))
    assert torch.equal(net(rgb, thermal, masks).logits, net(other, thermal, masks).logits)
    assert not torch.equal(net(rgb, thermal).logits, net(other, thermal).logits)


def test_images_that_mix_are_passed_one_by_one(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": MIXING})
    rgb, thermal = images(3)
    for one_by_one in (False, True):
        net = external(folder, one_by_one=one_by_one).eval()
        alone = torch.cat([net(rgb[n : n + 1], thermal[n : n + 1]).logits for n in range(3)])
        assert torch.equal(net(rgb, thermal).logits, alone) == one_by_one


def test_draws_come_from_the_generator_and_leave_no_trace(tmp_path: Path) -> None:
    net = external(write_checkout(tmp_path, {"model/net.py": DRAWS}))
    pair = images()
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()
    first, again, other = (net.train()(*pair, generator=generator(n)).logits for n in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.allclose(first, other)
    assert torch.equal(net.eval()(*pair).logits, net(*pair).logits)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()
    assert random.getstate() == before[2]
    with pytest.raises(ValueError, match="requires `generator`"):
        net.train()(*pair)


def test_training_may_read_other_scores(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path, {"model/net.py": PAIR})
    net = external(
        folder, feed="pair", scores=((0,),), train_scores=((1,), (1,)), auxiliary=(0,)
    )  # fmt: skip
    pair = images()
    evaluated = net.eval()(*pair)
    trained = net.train()(*pair, generator=generator())
    assert evaluated.aux == {}
    torch.testing.assert_close(trained.logits, -2 * evaluated.logits)
    torch.testing.assert_close(trained.aux["aux_logits"], evaluated.logits)
    record = record_of(net)
    assert record.auxiliary
    assert [(each.node, each.key) for each in record.requires] == [("loss", "reads_auxiliary")]


def test_copies_work_without_the_modules(tmp_path: Path) -> None:
    net = external(write_checkout(tmp_path, {"model/net.py": STACKED})).eval()
    teacher = copy.deepcopy(net)
    assert torch.equal(teacher(*images()).logits, net(*images()).logits)
    assert teacher.network.conv.weight is not net.network.conv.weight


STATE: dict[str, Any] = {"conv.weight": torch.ones(3, 4, 1, 1), "conv.bias": torch.zeros(3)}


@pytest.mark.parametrize(
    ("content", "prefix"),
    [
        (STATE, ""),
        ({"segmenter": STATE, "epoch_start": 3}, ""),
        ({"state_dict": {f"module.{key}": value for key, value in STATE.items()}}, ""),
        ({f"net.{key}": value for key, value in STATE.items()}, "net."),
    ],
)
def test_weights_of_the_author_are_loaded(
    tmp_path: Path, content: dict[str, Any], prefix: str
) -> None:
    folder = write_checkout(tmp_path / "code", {"model/net.py": STACKED})
    torch.save(content, tmp_path / "author.pth")
    net = external(folder, weights_prefix=prefix)
    report = load_weights(net, tmp_path / "author.pth")
    assert (report.num_set, report.num_entries) == (2, 2)
    assert bool((net.network.conv.weight == 1).all())


def test_weights_that_do_not_fit_are_refused_in_one_sentence(tmp_path: Path) -> None:
    folder = write_checkout(tmp_path / "code", {"model/net.py": STACKED})
    torch.save({"conv.weight": STATE["conv.weight"], "head": torch.ones(1)}, tmp_path / "w.pth")
    net = external(folder)
    before = copy.deepcopy(net.state_dict())
    with pytest.raises(InputError, match=r"conv\.bias is missing; head is unknown"):
        load_weights(net, tmp_path / "w.pth")
    assert all(torch.equal(before[key], value) for key, value in net.state_dict().items())
    torch.save(net.state_dict(), tmp_path / "own.pth")  # names of this project
    assert load_weights(net, tmp_path / "own.pth").num_set == 2
