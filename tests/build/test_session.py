"""Tables from counts, with numbers that can be followed by hand; which view and head predict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rgbt.build.session import decode_ahead, heads_of, result_tables, view_of
from rgbt.checks import InputError
from rgbt.data.cache.dataset import Decoded
from rgbt.data.domains import Domain, Domains
from rgbt.data.mfnet import MFNet
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions


def test_tables_pool_the_image_and_keep_regions_apart() -> None:
    # Two classes, two regions, one image by day and one by night.
    day = [[[6, 0], [2, 2]], [[10, 0], [0, 0]]]
    night = [[[4, 2], [0, 4]], [[8, 2], [0, 0]]]
    counts = Counts(
        counts=np.array([day, night]),
        names=("1D", "2N"),
        night=(False, True),
        classes=("road", "car"),
        partition="ring2",
        dataset="x",
        split="test",
    )
    regions = Regions(partition="ring", regions=2, aspect="image", absent="released")
    tables = result_tables(counts, regions, "mine", step=7)

    # Whole image: road 28 of 34 (28 right, 4 missed, 2 wrongly road), car 6 of 12.
    assert tables.classes.ious == pytest.approx((28 / 34, 6 / 12))
    assert tables.classes.accuracies == pytest.approx((28 / 32, 6 / 8))
    assert tables.regions.miou == pytest.approx((28 / 34 + 6 / 12) / 2)
    # Ring 1: road 10 of 14, car 6 of 10. Ring 2: road 18 of 20, car 0 of 2.
    rings = ((10 / 14 + 6 / 10) / 2, (18 / 20 + 0) / 2)
    assert tables.regions.region_ious == pytest.approx(rings)
    spread = 100 * (rings[0] - rings[1]) / 2
    assert tables.regions.variance == pytest.approx(spread**2)
    assert tables.classes.region_ious[1] == pytest.approx((6 / 10, 0))
    # Day: road 16 of 18, car 2 of 4. Night: road 12 of 16, car 4 of 8.
    assert tables.classes.subset_mious["day"] == pytest.approx((16 / 18 + 2 / 4) / 2)
    assert tables.classes.subset_mious["night"] == pytest.approx((12 / 16 + 4 / 8) / 2)
    assert (tables.region_names, tables.step) == (("ring_1", "ring_2"), 7)

    # Without the car every mean is what the road alone has; the classes stay as they are.
    road = result_tables(replace(counts, unscored=("car",)), regions, "mine", step=7)
    assert road.regions.miou == pytest.approx(28 / 34)
    assert road.regions.region_ious == pytest.approx((10 / 14, 18 / 20))
    assert road.regions.variance == pytest.approx((100 * (18 / 20 - 10 / 14) / 2) ** 2)
    assert road.classes.subset_mious == pytest.approx({"day": 16 / 18, "night": 12 / 16})
    assert road.classes == replace(
        tables.classes, unscored=("car",), subset_mious=road.classes.subset_mious
    )


class Network:
    views = ("rgb", "thermal")


def asked_session(source: dict[str, object], **changes: object) -> SimpleNamespace:
    """What `view_of` and `heads_of` ask of a session."""
    target = {"split": "x", "view": "rgb", "head": "dark", "labels": "none"}
    given = {
        "source": Domain(**{"split": "x", "view": None, "head": None, "labels": "given", **source}),
        **{"target": None, "target_is": None, "tested_head": "own", **changes},
    }
    if given["target_is"] is not None:
        given["target"] = Domain(**target)
    return SimpleNamespace(model=Network(), dataset=Nights(), domains=Domains(**given))


class Nights:
    def __init__(self) -> None:
        self.asked = 0

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        self.asked += 1
        if any(name not in ("day", "night") for name in names):
            raise InputError("no such frame")
        return tuple(name == "night" for name in names)


@pytest.mark.parametrize(("view", "seen"), [("thermal", "thermal"), ("rgb", "rgb"), (None, "rgb")])
def test_what_is_seen_is_what_the_source_is_seen_as(view: str | None, seen: str) -> None:
    """The network's first view only where the domain does not say."""
    session = asked_session({"view": view})
    assert view_of(session) == view_of(session, "default") == seen
    assert view_of(session, "thermal") == "thermal"
    with pytest.raises(InputError, match="modality: 'rgbt' is not a choice"):
        view_of(session, "rgbt")


def test_heads_of_known_images() -> None:
    session = asked_session({"head": "day", "view": "rgb"}, target_is="night")
    assert heads_of(session, "rgb")(("day", "night", "day")) == ("day", "dark", "day")
    assert heads_of(session, "rgb", "target")(("day", "night")) == ("dark", "dark")
    one = asked_session({"head": "day", "view": "rgb"}, target_is="night", tested_head="source")
    assert heads_of(one, "rgb")(("day", "night")) == ("day", "day")
    assert heads_of(one, "rgb", "own")(("day", "night")) == ("day", "dark")


def test_heads_of_images_that_are_in_no_list() -> None:
    """Files of one's own: whether they are of the night is not known, nor asked in vain."""
    session = asked_session({"head": "day", "view": "rgb"}, target_is="night")
    for asked, head in (("source", "day"), ("target", "dark")):
        assert heads_of(session, "rgb", asked)(("mine", "night")) == (head, head)
    assert session.dataset.asked == 0
    with pytest.raises(InputError, match=r"night, so that no head can be chosen; say head=source"):
        heads_of(session, "rgb")(("mine",))
    alone = asked_session({"view": "rgb"})
    assert heads_of(alone, "rgb")(("mine", "yours")) == (None, None)
    assert alone.dataset.asked == 0


@pytest.mark.parametrize("degraded", [False, True])
def test_images_of_the_splits_that_are_asked_for_are_decoded_ahead(
    write_mfnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, degraded: bool
) -> None:
    splits = {"train": ["00001D", "00002N"], "val": ["00003D"], "test": ["00004N"]}
    dataset = Decoded(MFNet(str(write_mfnet(splits))), tmp_path / "cache", num_threads=1)
    session = SimpleNamespace(dataset=SimpleNamespace(source=dataset) if degraded else dataset)
    decode_ahead(session, "train", "val")
    labels = {name: dataset.source.label(name) for name in (*splits["train"], *splits["val"])}

    def refuses(name: str) -> None:
        raise InputError(f"{name} was decoded")

    monkeypatch.setattr(dataset.source, "read", refuses)
    for name, label in labels.items():
        np.testing.assert_array_equal(dataset.read(name).label, label)
    with pytest.raises(InputError, match="00004N was decoded"):
        dataset.read("00004N")


def test_without_a_cache_nothing_is_decoded_ahead(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    (dataset.root / "images" / "00001D.png").unlink()
    decode_ahead(SimpleNamespace(dataset=dataset), "train")
