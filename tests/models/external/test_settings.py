"""Settings of the process are as before, whatever a checkout changes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from rgbt.checks import InputError
from rgbt.models.external.settings import kept_settings
from tests.models.external.standins import STACKED, external, images, write_checkout

CHANGES = """
import os
import torch

os.chdir("/")
os.environ["CUDA_VISIBLE_DEVICES"] = "7"
os.environ.pop("RGBT_SET_BEFORE", None)
torch.set_default_dtype(torch.float64)
torch.set_grad_enabled(False)
torch.set_num_threads(torch.get_num_threads() + 1)
torch.use_deterministic_algorithms(True)
torch.set_float32_matmul_precision("medium")
torch.backends.cudnn.benchmark = not torch.backends.cudnn.benchmark
torch.autograd.set_detect_anomaly(True)
torch.manual_seed(5)
"""


def state() -> tuple[object, ...]:
    return (
        *(os.getcwd(), dict(os.environ), torch.get_default_dtype(), torch.is_grad_enabled()),  # noqa: PTH109
        *(torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()),
        *(torch.get_float32_matmul_precision(), torch.backends.cudnn.benchmark),
        *(torch.is_anomaly_enabled(), torch.get_default_device()),
    )


def test_imports_of_a_checkout_change_no_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RGBT_SET_BEFORE", "1")
    folder = write_checkout(tmp_path, {"model/net.py": CHANGES + STACKED})
    before = state()
    with kept_settings():  # so that a failure of this test changes no other one
        net = external(folder)
        assert state() == before
    assert next(net.parameters()).requires_grad


@pytest.mark.parametrize("raised", ["SystemExit(0)", "type('Stop', (BaseException,), {})('now')"])
def test_whatever_foreign_code_raises_is_one_sentence(tmp_path: Path, raised: str) -> None:
    when_called = STACKED.replace("return self.conv(x)", f"raise {raised}")
    files = {"model/net.py": when_called, "model/early.py": f"raise {raised}"}
    folder = write_checkout(tmp_path, files)
    with pytest.raises(InputError, match="the network cannot predict 2 images .*, line 12"):
        external(folder)(*images(), generator=torch.Generator())
    with pytest.raises(InputError, match="cannot be imported"):
        external(folder, constructor="model.early:Net")
    stopped = STACKED.replace("return self.conv(x)", "raise KeyboardInterrupt")
    write_checkout(tmp_path / "other", {"model/net.py": stopped})
    with pytest.raises(KeyboardInterrupt):
        external(tmp_path / "other").eval()(*images())


def test_an_import_in_forward_names_the_module_of_the_checkout(tmp_path: Path) -> None:
    lazy = STACKED.replace("return self.conv(x)", "from model import blocks\n        return x")
    folder = write_checkout(tmp_path, {"model/net.py": lazy, "model/blocks.py": ""})
    with pytest.raises(InputError, match=r"imports 'model' of its checkout while it is called .*"):
        external(folder).eval()(*images())
