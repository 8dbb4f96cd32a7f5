"""Statistics of batch normalisation: their values, their images, and the counts with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.assembly.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.mfnet import MFNet
from rgbt.evaluation.batch_norm import normalised
from rgbt.evaluation.measure import measure, measurement_of
from rgbt.evaluation.predict import Predictor
from rgbt.metrics.measurement import Measurement, Statistics
from rgbt.requirements import NetworkRecord
from rgbt.runs.specify import specify
from rgbt.types import Output
from tests.commands import SPLITS, words_of


class AboveMean(nn.Module):
    """Class 1 where the thermal image is above the running mean, else class 0."""

    record = NetworkRecord(views=("rgbt",))

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(4)
        self.unused = nn.BatchNorm2d(2)
        self.sizes: list[int] = []

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: tuple[str, ...] = ()) -> Output:
        self.sizes.append(len(rgb))
        above = self.norm(torch.cat([rgb, thermal], 1))[:, 3] > 0
        return Output(F.one_hot(above.long(), 9).movedim(-1, 1).float(), {})


class Days(MFNet):
    """Its split "days" has no image of the night."""

    def names(self, split: str) -> tuple[str, ...]:
        return ("00002D", "00004D") if split == "days" else super().names(split)


@pytest.fixture
def session(data: Path) -> Session:
    words = words_of(data, data / "runs", "+experiment=mfnet", "masker.patch_size=null")
    session = open_session(specify(compose(words)))
    return replace(session, dataset=Days(data), model=AboveMean())


def wanted(session: Session, kind: Statistics = "as trained", *splits: str) -> Measurement:
    return measurement_of(session, "test", batch_norm=kind, batch_norm_splits=",".join(splits))


def pixels(session: Session, *names: str) -> NDArray[np.float64]:
    """(pixels, 4): red, green, blue and thermal of all pixels of some images, in [0, 1]."""
    samples = [session.dataset.read(name) for name in names]
    images = [np.dstack([sample.rgb, sample.thermal]).reshape(-1, 4) for sample in samples]
    return np.concatenate(images) / 255


@pytest.mark.parametrize("size", [1, 3])
def test_statistics_are_those_of_all_pixels_in_any_order(session: Session, size: int) -> None:
    session = replace(session, loading=replace(session.loading, eval_batch_size=size))
    model, predictor = session.model, Predictor(session)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    names = tuple(SPLITS["train"])
    expected = pixels(session, *names)
    for sources in (names, names[::-1]):
        with normalised(session, predictor, wanted(session, "recomputed"), sources):
            assert model.norm.running_mean.numpy() == pytest.approx(expected.mean(0), abs=1e-6)
            assert model.norm.running_var.numpy() == pytest.approx(expected.var(0), abs=1e-6)
            assert torch.equal(model.unused.running_var, torch.ones(2))
            assert not model.norm.training
        for name, tensor in model.state_dict().items():
            assert torch.equal(tensor, before[name])


TRAIN_DAYS, TRAIN_NIGHTS = ([n for n in SPLITS["train"] if n[-1] == t] for t in "DN")


@pytest.mark.parametrize(
    ("kind", "splits", "of_day", "of_night"),
    [
        ("recomputed", ("days",), ["00002D", "00004D"], ["00002D", "00004D"]),
        ("adabn", (), ["00201D", "00203D"], ["00202N"]),
        ("adabn", ("train", "days"), TRAIN_DAYS, TRAIN_NIGHTS),
        ("batch", (), ["00201D", "00203D"], ["00202N"]),  # batches of two
    ],
)
def test_counts_are_of_the_statistics_of_each_domain(
    session: Session,
    kind: Statistics,
    splits: tuple[str, ...],
    of_day: list[str],
    of_night: list[str],
) -> None:
    result = measure(session, wanted(session, kind, *splits))
    assert result.counts.names == tuple(SPLITS["test"])
    for name, counts in zip(result.counts.names, result.counts.counts, strict=True):
        mean = pixels(session, *(of_night if name[-1] == "N" else of_day))[:, 3].mean()
        counted = session.dataset.label(name).ravel() != 255
        above = (pixels(session, name)[:, 3] > mean)[counted]
        assert counts.sum((0, 1))[:2].tolist() == [(~above).sum(), above.sum()]
    assert torch.equal(session.model.norm.running_mean, torch.zeros(4))
    # Without the option, the network keeps its own mean of 0, and every batch is whole.
    session.model.sizes.clear()
    plain = measure(session, wanted(session)).counts.counts
    assert plain.sum((0, 1, 2))[0] == (pixels(session, *SPLITS["test"])[:, 3] == 0).sum()
    assert session.model.sizes == [2, 1]


def test_statistics_that_cannot_be_computed_are_refused(session: Session) -> None:
    with pytest.raises(InputError, match="batch_norm_splits=days"):
        measure(session, wanted(session, "adabn", "days"))
    assert not session.model.sizes
    exported = nn.Sequential(nn.BatchNorm2d(3, track_running_stats=False))
    exported.record = AboveMean.record
    with pytest.raises(InputError, match="batch_norm=adabn"):
        measure(replace(session, model=exported), wanted(session, "adabn"))


@pytest.mark.parametrize("kind", ["batch", "adabn"])
def test_one_value_for_each_channel_is_refused(session: Session, kind: Statistics) -> None:
    """Of a batch of one image at night it would be normalised to 0, whatever the image."""
    model = session.model
    model.norm.register_forward_pre_hook(lambda _, inputs: (inputs[0].mean((2, 3), keepdim=True),))
    with pytest.raises(InputError, match=r"set data\.eval_batch_size"):
        measure(session, wanted(session, kind))
    assert torch.equal(model.norm.running_mean, torch.zeros(4))


def test_options_make_the_measurement(session: Session) -> None:
    """The size of a batch belongs to other statistics than those of the training alone."""
    size = ("data.eval_batch_size", str(session.loading.eval_batch_size))
    plain, batch = wanted(session), wanted(session, "batch")
    assert (plain.statistics, plain.statistics_of, plain.changed) == ("as trained", (), ())
    assert (batch.statistics, batch.statistics_of) == ("batch", ())
    assert set(batch.settings) - set(plain.settings) == {size}
    found = wanted(session, "adabn", "train_day", "train_night", "train_day")
    assert (found.statistics, found.statistics_of) == ("adabn", ("train_day", "train_night"))
    assert found.words == ("adabn-train_day-train_night",)
    assert found.label == "AdaBN of train_day, train_night"
    assert set(found.settings) - set(plain.settings) == {size}
    kinds: tuple[Statistics, ...] = ("as trained", "batch")
    for kind in kinds:
        with pytest.raises(InputError, match=f"batch_norm={kind}"):
            wanted(session, kind, "val")
