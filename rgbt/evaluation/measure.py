"""Predict the images of a split, and count them by image, region, label and class.

Details are counted in the same pass: boundaries, calibration, distance and size of objects.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rgbt.assembly.session import Session, measured_settings, reader_settings
from rgbt.checks import InputError, split_list
from rgbt.config.common_options import AS_TRAINED
from rgbt.data.domains import TestedHead
from rgbt.data.loaders import eval_batches
from rgbt.dataset import KnownScenes, LabelledDataset, reader_of
from rgbt.engine.memory import naming_memory
from rgbt.evaluation.batch_norm import normalised, parts_of_split
from rgbt.evaluation.corruption import CorruptedDataset
from rgbt.evaluation.predict import Predictor, view_of
from rgbt.metrics.counting import detail_counts, region_counts
from rgbt.metrics.counts import Counts, read_measurement
from rgbt.metrics.details import SCENE_KINDS, DetailKind, Details
from rgbt.metrics.measurement import Measurement, Statistics, settings_of
from rgbt.metrics.scores import extremes
from rgbt.processes import collected, num_processes
from rgbt.terminal import info, progress
from rgbt.tracking.pictures import write_strip
from rgbt.transforms.maps import nearest
from rgbt.types import Batch, Sample, View

EVALUATIONS = "evaluations"  # folder, in that of a run, of measurements that it did not end with

# Images of the qualitative panel: the same number by day and by night if the split has both.
NUM_PANELS = 6

Matrix: TypeAlias = NDArray[np.int64]
# A sample, and its predicted classes at the size of its label.
Kept: TypeAlias = tuple[Sample, NDArray[np.uint8]]

# What one process counted: of each image the counts of each kind ("": the confusion matrices of
# the regions), images for pictures, and names of unreadable images.
Part: TypeAlias = tuple[dict[str, dict[str, Matrix]], list[Kept], list[str]]


@dataclass(frozen=True)
class Measured:
    """Counts of one split per image and region, those of details by kind, and kept images.

    `skipped` are unreadable images, of the split and of statistics of batch normalisation.
    """

    counts: Counts
    details: Mapping[DetailKind, Counts]
    kept: tuple[Kept, ...] = ()
    skipped: tuple[str, ...] = ()


def measurement_of(
    session: Session,
    split: str,
    view: View | None = None,
    head: TestedHead | None = None,
    batch_norm: Statistics = "as trained",
    batch_norm_splits: str = "",
) -> Measurement:
    """Return what is measured: the network of `session` on its data set, which may be corrupted.

    None means: the view and the head of the run's configuration. InputError: a view or splits
    without effect.
    """
    if batch_norm_splits and batch_norm in (AS_TRAINED, "batch"):
        without = f"batch_norm_splits={batch_norm_splits} has no effect"
        raise InputError(f"{without} with batch_norm={batch_norm}.")
    named = split_list(batch_norm_splits, "batch_norm_splits") if batch_norm_splits else []
    tested = session.domains.tested_head or ""
    dataset = session.dataset
    values = measured_settings(session.spec.plain) | reader_settings(dataset)
    changed = []
    if view_of(session, view) != view_of(session):
        changed.append("view")
    if (head or tested) != tested:
        changed.append("head")
    changed += session.changed
    if session.checkpoint != "best":
        changed.append("checkpoint")
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
    """Return the measurement that is counted in another way: details, or pairs of frames."""
    return replace(wanted, partition=partition, changed=(*wanted.changed, "partition"))


def predictor_of(session: Session, wanted: Measurement) -> Predictor:
    """Return the predictor of a measurement.

    InputError: a view or a head that the network does not have, or a split that there is not.
    """
    head: Any = wanted.head or None
    predictor = Predictor(session, wanted.view, head)  # type: ignore[arg-type]
    parts_of_split(session.dataset, wanted)
    return predictor


def measure(
    session: Session,
    wanted: Measurement,
    details: Sequence[Details] = (),
    keep: Sequence[str] = (),
    only: Sequence[str] = (),
) -> Measured:
    """Predict a split with the network of `session`, and count, with a progress bar.

    Several processes of a run predict a part of the split each, and return the same result. The
    network is left in evaluation mode.

    Args:
        session: with the network and the data set of the measurement (`measurement_of`).
        wanted: the measurement.
        details: what else to count.
        keep: names of the images that are returned for pictures.
        only: names of the images that are predicted; (): all of the split.

    Raises:
        InputError: a file cannot be read, or a measurement that does not fit the network or data.
    """
    predictor, dataset, regions = predictor_of(session, wanted), session.dataset, session.regions
    for detail in details:
        if detail.kind in SCENE_KINDS and not isinstance(reader_of(dataset), KnownScenes):
            raise InputError(f"details={detail.kind}: {dataset.name} has no maps of its scenes.")
    num_images, num_classes = session.loading.eval_batch_size, len(dataset.classes)
    advice = "Predict windows with prediction.window_hw=[...], or use trainer.accelerator=cpu."
    if num_images > 1:
        advice = "Set data.eval_batch_size=1, with equal results."
    memory = naming_memory(session.device, f"an evaluation of {num_images} images at once", advice)
    counted: dict[str, dict[str, Matrix]] = {}
    kept: list[Kept] = []
    skipped: list[str] = []
    needs_confidence = any(detail.kind == "calibration" for detail in details)
    predicted = _predicted(
        session, predictor, wanted, skipped, only, needs_confidence=needs_confidence
    )
    with memory, closing(predicted):
        for name, label, classes, confidence in predicted:
            counted[name] = {"": region_counts(label, classes, num_classes, regions)}
            for detail in details:
                values = _values(detail.kind, dataset, name, confidence)
                counted[name][detail.kind] = detail_counts(
                    detail, label, classes, values, num_classes, regions
                )
            if name in keep:
                kept.append(_with_sample(dataset, name, classes.numpy()))
    counted, kept, skipped = joined(
        collected((counted, kept, skipped)), dataset.names(wanted.split)
    )
    by_kind: dict[DetailKind, Counts] = {}
    for detail in details:
        # The sums of calibration are large.
        dtype = np.int64 if detail.kind == "calibration" else np.int32
        by_name = {name: matrices[detail.kind] for name, matrices in counted.items()}
        detailed = of_partition(wanted, detail.partition(regions.name))
        by_kind[detail.kind] = counts_of(dataset, detailed, by_name, dtype)
    by_name = {name: matrices[""] for name, matrices in counted.items()}
    counts = counts_of(dataset, wanted, by_name)
    return Measured(counts, by_kind, tuple(kept), tuple(skipped))


def _predicted(
    session: Session,
    predictor: Predictor,
    wanted: Measurement,
    skipped: list[str],
    only: Sequence[str],
    *,
    needs_confidence: bool,
) -> Generator[tuple[str, Tensor, Tensor, Tensor | None], None, None]:
    """Yield name, label, classes and confidence (H, W) of every image of a split.

    The network has the wanted statistics meanwhile. Names of unreadable images, also of the
    statistics, are added to `skipped`.
    """

    def predict(batch: Batch) -> tuple[Tensor, Sequence[Tensor | None]]:
        if not needs_confidence:
            return predictor.classes(batch).cpu(), [None] * len(batch.name)
        classes, confidence = predictor.confident_classes(batch)
        return classes.cpu(), list(confidence.cpu())

    for part, sources in parts_of_split(session.dataset, wanted):
        names = tuple(name for name in part if name in only) if only else part
        with normalised(session, predictor, wanted, sources) as unmeasured:
            batches = eval_batches(session.dataset, names, session.transform, session.loading)
            for loaded in shown(batches, wanted.split, len(names)):
                batch = predictor.counted(loaded)
                classes, confidences = predict(batch.to(session.device))
                yield from zip(batch.name, batch.label, classes, confidences, strict=True)
        skipped += (*batches.skipped, *unmeasured)


def _values(
    kind: DetailKind, dataset: LabelledDataset, name: str, confidence: Tensor | None
) -> Any:
    """The map (H, W) beside label and classes that details of a kind are counted by, if any."""
    if kind == "calibration":
        return confidence
    if kind == "boundary":
        return None
    reader = reader_of(dataset)
    assert isinstance(reader, KnownScenes), "`measure` refuses others"
    scene = reader.scene_maps(name)
    return scene.depth_m if kind == "distance" else scene.objects


def _with_sample(dataset: LabelledDataset, name: str, classes: NDArray[np.uint8]) -> Kept:
    """The sample called `name` and its classes, which may be counted at another size."""
    sample = dataset.read(name)
    height, width = (sample.thermal if sample.label is None else sample.label).shape
    return sample, nearest(classes, (height, width))


def joined(parts: Sequence[Part], names: Sequence[str]) -> Part:
    """Join the parts of all processes and domains, in the order of `names`."""
    position = {name: index for index, name in enumerate(names)}
    counted: dict[str, dict[str, Matrix]] = {}
    kept: list[Kept] = []
    skipped: list[str] = []
    for counted_part, kept_part, skipped_part in parts:
        counted |= counted_part
        kept += kept_part
        skipped += skipped_part
    return (
        {name: counted[name] for name in position if name in counted},
        sorted(kept, key=lambda image: position[image[0].name]),
        sorted(dict.fromkeys(skipped), key=lambda name: position.get(name, len(position))),
    )


def shown(batches: Any, what: str, total: int) -> Iterator[Batch]:
    """Yield the batches, with a progress bar over the images of all processes."""
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
    """Join the counts (R, K, K) of images to those of a split; InputError if there is none."""
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
    """Return the file of the counts of a measurement: in the run folder, or in evaluations/."""
    is_beside = wanted.is_own or not session.run
    return (session.folder if is_beside else session.folder / EVALUATIONS) / wanted.file_name


def files_of(
    session: Session, wanted: Measurement, details: Sequence[Details] = (), out: Path | None = None
) -> dict[Path, Measurement]:
    """Return the file of a measurement, then those of its details; `out`: instead of `path_of`."""
    found = {out or path_of(session, wanted): wanted}
    for detail in details:
        detailed = of_partition(wanted, detail.partition(session.regions.name))
        beside = out and out.with_name(f"{out.stem}-{detail.kind}{out.suffix}")
        found[beside or path_of(session, detailed)] = detailed
    return found


def stored(session: Session, files: Mapping[Path, Measurement]) -> dict[Path, Counts]:
    """Load the counts that their files hold already, with the scored classes of `session`.

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
    """Return whether a file holds this measurement, and not of an earlier step of the training.

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


def panel_names(dataset: LabelledDataset, split: str) -> tuple[str, ...]:
    """Return the first images of a split, half by day and half by night where it holds both."""
    names = dataset.names(split)
    at_night = dataset.nights(names) or (False,) * len(names)
    night = [name for name, dark in zip(names, at_night, strict=True) if dark]
    day = [name for name, dark in zip(names, at_night, strict=True) if not dark]
    num_day = min(len(day), max(NUM_PANELS // 2, NUM_PANELS - len(night)))
    return tuple(day[:num_day] + night[: NUM_PANELS - num_day])


def extreme_pictures(session: Session, counts: Counts) -> dict[str, Path]:
    """Return the files of the pictures of the best, the median and the worst image, by its name."""
    found = extremes(counts).items()
    return {name: session.folder / "figures" / f"{word}.png" for word, (name, _) in found}


def draw_extremes(session: Session, counts: Counts, *, writes: bool = True) -> None:
    """Predict the images of `extreme_pictures` again and write their pictures.

    Every process of a run calls this; one of them `writes`.
    """
    paths = extreme_pictures(session, counts)
    if not paths:
        return
    kept = measure(session, counts.measurement, keep=tuple(paths), only=tuple(paths)).kept
    for sample, classes in kept if writes else ():
        paths[sample.name].parent.mkdir(exist_ok=True)
        write_strip(sample, classes, session.dataset, paths[sample.name])


def draw_missing(session: Session, counts: Counts) -> None:
    """Draw the pictures that the folder of a run lacks, if `counts` are those of its own test."""
    wanted = counts.measurement
    paths = extreme_pictures(session, counts)
    if wanted.is_own and wanted.split == "test" and not all(map(Path.exists, paths.values())):
        draw_extremes(session, counts)
        info(f"{', '.join(path.name for path in paths.values())} are in {session.folder}/figures.")
