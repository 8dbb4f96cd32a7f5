"""Measure: predict the images of a split, and count by image, region, label and class.

Details are counted in the same pass: boundaries, calibration, distance and size of objects.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rgbt.assembly.session import Session, measured_settings, reader_settings
from rgbt.checks import InputError, split_list
from rgbt.config.common_options import AS_TRAINED
from rgbt.data.domains import TestedHead
from rgbt.data.loaders import eval_batches
from rgbt.dataset import KnownScenes, LabelledDataset, Subset, background_indices, reader_of
from rgbt.engine.memory import naming_memory
from rgbt.engine.progress import progress
from rgbt.evaluation.batch_norm import normalised, parts_of_split
from rgbt.evaluation.corruption import CorruptedDataset
from rgbt.evaluation.predictor import Predictor, view_of
from rgbt.metrics.counting import DetailCounter, RegionCounter
from rgbt.metrics.counts import Counts, read_measurement
from rgbt.metrics.details import SCENE_KINDS, DetailKind, Details
from rgbt.metrics.measurement import Measurement, Statistics, settings_of
from rgbt.processes import collected, num_processes
from rgbt.tracking.pictures import Legend, PanelExample
from rgbt.transforms.maps import nearest
from rgbt.types import Batch, View

EVALUATIONS = "evaluations"  # folder, in that of a run, of measurements that it did not end with

# Images of the qualitative panel: the same number by day and by night if the split has both.
NUM_PANELS = 6

Matrix: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True)
class Measured:
    """Counts of one split per image and region, those of details by kind, and kept examples.

    `skipped` are unreadable images, of the split and of statistics of batch normalisation.
    """

    counts: Counts
    details: Mapping[DetailKind, Counts]
    kept: tuple[PanelExample, ...] = ()
    skipped: tuple[str, ...] = ()


class Counted(NamedTuple):
    """What one process has counted: of each image counts (R, K, K), and by kind (R G, M, K)."""

    counts: dict[str, Matrix]
    details: dict[str, dict[DetailKind, Matrix]]
    kept: list[PanelExample]
    skipped: list[str]


def measurement_of(
    session: Session,
    split: str,
    view: View | None = None,
    head: TestedHead | None = None,
    batch_norm: Statistics = "as trained",
    batch_norm_splits: str = "",
) -> Measurement:
    """The measurement of the network of `session` on its data set, which may be corrupted.

    None means: the view and the head of the run's configuration. InputError: a view or splits
    without effect.
    """
    if batch_norm_splits and batch_norm in (AS_TRAINED, "batch"):
        without = f"batch_norm_splits={batch_norm_splits} has no effect"
        raise InputError(f"{without} with batch_norm={batch_norm}.")
    named = split_list(batch_norm_splits, "batch_norm_splits") if batch_norm_splits else []
    tested = session.domains.tested_head or ""
    values, dataset = measured_settings(session.spec.plain), session.dataset
    changed = ["view"] if view_of(session, view) != view_of(session) else []
    changed += ["head"] if (head or tested) != tested else []
    values |= reader_settings(dataset)
    changed += [*session.changed, *(["checkpoint"] if session.checkpoint != "best" else [])]
    if batch_norm != AS_TRAINED:
        changed += ["statistics"]
    else:  # the size of a batch changes nothing
        del values["data.eval_batch_size"]
        changed = [key for key in changed if key != "data.eval_batch_size"]
    corruption: dict[str, Any] = {}
    if isinstance(dataset, CorruptedDataset) and dataset.severity:
        chosen, kind = dataset.chosen, dataset.corruption
        values |= chosen.settings
        changed += ["severity", *chosen.changed]
        shown = {"corruption": chosen.name, "title": kind.title, "unit": kind.unit}
        corruption = {"severity": float(dataset.severity), **shown}
    return Measurement(
        run=session.run,
        weights=session.digest,
        checkpoint=session.checkpoint,
        step=session.step,
        dataset=dataset.fingerprint(),
        split=split,
        partition=session.regions.name,
        statistics=batch_norm,
        statistics_of=tuple(dict.fromkeys(named)),
        settings=settings_of(values),
        absent=session.regions.absent,
        changed=tuple(changed),
        dataset_name=dataset.name,
        dataset_words=session.dataset_words,
        view=view_of(session, view),
        head=head or tested,
        **corruption,
    )


def of_partition(wanted: Measurement, partition: str) -> Measurement:
    """The same measurement, counted in another way: details, or pairs of frames."""
    return replace(wanted, partition=partition, changed=(*wanted.changed, "partition"))


def check(session: Session, wanted: Measurement) -> Predictor:
    """The predictor of a measurement; InputError: a view, head or split that there is not."""
    head: Any = wanted.head or None
    predictor = Predictor(session, wanted.view, head)  # type: ignore[arg-type]
    parts_of_split(session.dataset, wanted)
    return predictor


def measure(
    session: Session,
    wanted: Measurement,
    details: Sequence[Details] = (),
    keep: Sequence[str] = (),
) -> Measured:
    """Predict a split with the network of `session`, and count, with a progress bar.

    Several processes of a run predict a part of the split each, and return the same result. The
    network is left in evaluation mode.

    Args:
        session: with the network and the data set of the measurement (`measurement_of`).
        wanted: the measurement.
        details: what else to count.
        keep: names of the images that are returned for pictures.

    Raises:
        InputError: a file cannot be read, or a measurement that does not fit the network or data.
    """
    predictor = check(session, wanted)
    counters = _detail_counters(session, details)
    regions = RegionCounter(len(session.dataset.classes), session.regions)
    found = Counted({}, {}, [], [])
    images = session.loading.eval_batch_size
    advice = "Predict windows with prediction.window_hw=[...], or use trainer.accelerator=cpu."
    if images > 1:
        advice = "Set data.eval_batch_size=1, with equal results."
    memory = naming_memory(session.device, f"an evaluation of {images} images at once", advice)
    with memory, closing(_batches(session, predictor, wanted, found.skipped)) as batches:
        for loaded in batches:
            batch = predictor.counted(loaded)
            on_device = batch.to(session.device)
            if "calibration" in counters:
                classes, confidence = predictor.confident_classes(on_device)
                sure: Sequence[Tensor | None] = list(confidence.cpu())
            else:
                classes, sure = predictor.classes(on_device), [None] * len(batch.name)
            images_of = zip(batch.name, batch.label, classes.cpu(), sure, strict=True)
            for name, label, predicted, each in images_of:
                found.counts[name] = regions(label, predicted)
                maps = (label, predicted, each)
                found.details[name] = _details_of(counters, session.dataset, name, maps)
                kept = [name] if name in keep else []
                found.kept.extend(_example(session, each, predicted.numpy()) for each in kept)
    every = joined(collected(found), session.dataset.names(wanted.split))
    by_kind = {}
    for kind_of in details:
        kind = kind_of.kind
        by_name = {name: counts[kind] for name, counts in every.details.items()}
        # The sums of calibration are large.
        dtype = np.int64 if kind == "calibration" else np.int32
        detailed = of_partition(wanted, kind_of.partition(session.regions.name))
        by_kind[kind] = counts_of(session.dataset, detailed, by_name, dtype)
    return Measured(
        counts=counts_of(session.dataset, wanted, every.counts),
        details=by_kind,
        kept=tuple(every.kept),
        skipped=tuple(every.skipped),
    )


def _batches(
    session: Session, predictor: Predictor, wanted: Measurement, skipped: list[str]
) -> Generator[Batch, None, None]:
    """The batches of a split; while one is used, the network has the wanted statistics.

    Names of unreadable images, also of the statistics, are added to `skipped`.
    """
    for names, sources in parts_of_split(session.dataset, wanted):
        images = Subset(session.dataset, names)
        with normalised(session, predictor, wanted, sources) as unmeasured:
            batches = eval_batches(images, wanted.split, session.transform, session.loading)
            yield from shown(batches, wanted.split, len(names))
        skipped += (*batches.skipped, *unmeasured)


def shown(batches: Any, what: str, total: int) -> Iterator[Batch]:
    """The batches, with a progress bar over the images of all processes."""
    with progress() as display:
        task = display.add_task(what, total=total, note="images")
        done = 0
        for batch in batches:
            yield batch
            done = min(total, done + num_processes() * len(batch.name))
            display.update(task, completed=done)


def counts_of(
    dataset: LabelledDataset,
    wanted: Measurement,
    by_name: Mapping[str, Matrix],
    dtype: type[np.integer] = np.int32,
) -> Counts:
    """The counts (R, K, K) of each image as those of a split; InputError if there is none."""
    names = tuple(by_name)
    if not names:
        raise InputError(f"split '{wanted.split}' of {dataset.name}: no image could be read.")
    return Counts(
        counts=np.stack(list(by_name.values())).astype(dtype),
        names=names,
        night=dataset.nights(names),
        classes=dataset.classes,
        unscored=dataset.unscored,
        measurement=wanted,
    )


def path_of(session: Session, wanted: Measurement) -> Path:
    """The file of the counts of a measurement: in the folder of the run, or in evaluations/."""
    is_beside = wanted.is_own or not session.run
    return (session.folder if is_beside else session.folder / EVALUATIONS) / wanted.file_name


def files_of(
    session: Session, wanted: Measurement, details: Sequence[Details] = (), out: Path | None = None
) -> dict[Path, Measurement]:
    """The file of a measurement, then those of its details; `out`: instead of `path_of`."""
    found = {out or path_of(session, wanted): wanted}
    for each in details:
        detailed = of_partition(wanted, each.partition(session.regions.name))
        beside = out and out.with_name(f"{out.stem}-{each.kind}{out.suffix}")
        found[beside or path_of(session, detailed)] = detailed
    return found


def stored(session: Session, files: Mapping[Path, Measurement]) -> dict[Path, Counts]:
    """The counts that their files hold already, with the scored classes of `session`.

    InputError: a file holds another measurement, which is never replaced.
    """
    found = {}
    for path, wanted in files.items():
        images = len(set(session.dataset.names(wanted.split)))
        if (counts := _stored(path, wanted, images)) is not None:
            # How they are scored is no part of a measurement.
            unscored = session.dataset.unscored
            found[path] = replace(counts, measurement=wanted, unscored=unscored)
    return found


def store(
    files: Iterable[Path], made: Measured, before: Mapping[Path, Counts]
) -> dict[Path, Counts]:
    """Write what was measured; files of `before` stay, as another machine may have made them."""
    found = {}
    for path, counts in zip(files, (made.counts, *made.details.values()), strict=True):
        found[path] = before.get(path, counts)
        if path not in before:
            path.parent.mkdir(parents=True, exist_ok=True)
            counts.save(path)
    return found


def _stored(path: Path, wanted: Measurement, images: int) -> Counts | None:
    """The counts of a measurement of all `images`; None: there are none, or of an earlier step."""
    if not check_replaceable(path, wanted):
        return None
    counts = Counts.load(path)
    # Unreadable images of a run's own test are part of its result.
    return counts if wanted.is_own or len(counts.names) == images else None


def check_replaceable(path: Path, wanted: Measurement) -> bool:
    """Whether a file holds this measurement, and not of an earlier step of the training.

    InputError: it holds another one, which is not replaced.
    """
    if not path.exists():
        return False
    try:
        differing = wanted.differences(read_measurement(path))
    except InputError as error:
        raise InputError(f"{error} Remove the file to replace it.") from error
    if not set(differing) <= {"step"}:
        raise InputError(
            f"{path} holds another measurement ({', '.join(differing)}); remove it, or name "
            "another file with out=..."
        )
    return not differing


def _detail_counters(
    session: Session, details: Sequence[Details]
) -> dict[DetailKind, DetailCounter]:
    """A counter of each kind; InputError for scenes that the data set does not know."""
    dataset, regions, num_classes = session.dataset, session.regions, len(session.dataset.classes)
    for each in details:
        if each.kind in SCENE_KINDS and not isinstance(reader_of(dataset), KnownScenes):
            raise InputError(f"details={each.kind}: {dataset.name} has no maps of its scenes.")
    return {each.kind: DetailCounter(num_classes, regions, each) for each in details}


def _details_of(
    counters: Mapping[DetailKind, DetailCounter],
    dataset: LabelledDataset,
    name: str,
    maps: tuple[Tensor, Tensor, Tensor | None],
) -> dict[DetailKind, Matrix]:
    """The details of one image from its label, classes and confidences (H, W)."""
    label, classes, confidence = maps
    further: dict[DetailKind, tuple[Any, ...]] = {"boundary": (), "calibration": (confidence,)}
    if counters.keys() & set(SCENE_KINDS):
        reader = reader_of(dataset)
        assert isinstance(reader, KnownScenes), "otherwise there is no such counter"
        scene = reader.scene_maps(name)
        further |= {"distance": (scene.depth_m,), "size": (scene.objects,)}
    return {kind: count(label, classes, *further[kind]) for kind, count in counters.items()}


def joined(parts: Sequence[Counted], names: Sequence[str]) -> Counted:
    """The parts of all processes and domains together, in the order of `names`."""
    position = {name: index for index, name in enumerate(names)}
    counts = {name: found for each in parts for name, found in each.counts.items()}
    details = {name: found for each in parts for name, found in each.details.items()}
    kept = [example for each in parts for example in each.kept]
    skipped = [name for each in parts for name in each.skipped]
    return Counted(
        {name: counts[name] for name in names if name in counts},
        {name: details[name] for name in names if name in details},
        sorted(kept, key=lambda example: position[example.name]),
        sorted(dict.fromkeys(skipped), key=lambda name: position.get(name, len(position))),
    )


def _example(session: Session, name: str, classes: NDArray[np.uint8]) -> PanelExample:
    sample = session.dataset.read(name)
    label = sample.label if sample.label is not None else np.full_like(sample.thermal, 255)
    # Classes may be counted at another size than that of the label file.
    at_label = nearest(classes, (label.shape[0], label.shape[1]))
    return PanelExample(name, sample.rgb, sample.thermal, label, at_label)


def legend_of(dataset: LabelledDataset) -> Legend:
    """Classes of a data set and their colours."""
    palette = np.array(dataset.palette, np.uint8)
    return Legend(dataset.classes, palette, background_indices(dataset))


def panel_names(dataset: LabelledDataset, split: str) -> tuple[str, ...]:
    """The first images of a split, half by day and half by night where it holds both."""
    names = dataset.names(split)
    at_night = dataset.nights(names) or (False,) * len(names)
    night = [name for name, dark in zip(names, at_night, strict=True) if dark]
    day = [name for name, dark in zip(names, at_night, strict=True) if not dark]
    num_day = min(len(day), max(NUM_PANELS // 2, NUM_PANELS - len(night)))
    return tuple(day[:num_day] + night[: NUM_PANELS - num_day])
