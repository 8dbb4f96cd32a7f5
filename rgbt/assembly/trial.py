"""Use the components of a run once before it is trained, so that mistakes are seen early."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.assembly.contracts import check_dataset, check_part, check_regions, is_own
from rgbt.assembly.session import Session
from rgbt.checks import InputError, one_line
from rgbt.config.stored_config import EXTERNAL
from rgbt.dataset import reader_of
from rgbt.maskers.masker import check_masker
from rgbt.randomness import numpy_generator, torch_generator
from rgbt.requirements import name_of
from rgbt.types import AnyMasker, Sample

# Split -> names of its images.
Lists = Mapping[str, tuple[str, ...]]


def try_parts(
    session: Session, names: Lists, masker: AnyMasker, records: Mapping[str, Any]
) -> None:
    """Use a user's own parts, an author's network, masker and cameras once.

    InputError names the part, and what it returned or raised.
    """
    transform, seed = session.transform, session.spec.seed_of("order")
    check_dataset(reader_of(session.dataset), names)
    check_part("transform", transform)
    first = first_readable(session, names[session.domains.source.split])
    shown = first_readable(session, names["test"])
    check_regions(session.regions, shown.thermal.shape)
    example_hw = transform.train(first, numpy_generator(seed, "probe")).thermal.shape
    tested = transform.test(shown)
    if session.spec.model.target == EXTERNAL:
        _try_external(session, example_hw, tested.thermal.shape)
    elif session.loading.batch_size == session.trainer.batch_norm_parts:
        _try_single(session, example_hw)
    crop_hw = (not is_own(masker) and records["transform"].crop_hw) or example_hw
    if records["masker"].hides_cells:
        check_masker(masker, crop_hw, torch_generator(seed, "probe"))
    cameras = [("scheme", records["scheme"].camera, example_hw)]
    if session.consistency.sets:
        camera = session.consistency.view.camera
        cameras += [("consistency", camera, tested.rgb.shape[:2])]
        cameras += [("consistency", camera, tested.label.shape[:2])]
    for node, camera, image_hw in cameras:
        try:
            if camera is not None:
                camera.matrix(image_hw)
        except InputError as error:
            raise InputError(f"{node}.view.{error}") from error


def first_readable(session: Session, names: tuple[str, ...]) -> Sample:
    """Read the first of these samples; unreadable ones are skipped where the run does so too."""
    for name in names if session.loading.on_error != "raise" else ():
        with suppress(InputError):
            return session.dataset.read(name)
    return session.dataset.read(names[0])


def _black(session: Session, count: int, image_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return a batch of black images: RGB and thermal."""
    rgb = torch.zeros(count, 3, *image_hw, device=session.device)
    return rgb, torch.zeros(count, 1, *image_hw, device=session.device)


def _generator(session: Session) -> torch.Generator:
    return torch_generator(session.spec.seed_of("order"), "probe")


def _try_single(session: Session, train_hw: tuple[int, int]) -> None:
    """Refuse batches of one image where a batch normalisation gets one pixel: without variance."""
    model, was_training = session.model, session.model.training
    if not any(isinstance(module, _BatchNorm) for module in model.modules()):
        return
    before = {name: value.clone() for name, value in model.named_buffers()}
    try:
        with torch.no_grad(), session.autocast():
            model.train()(*_black(session, 1, train_hw), generator=_generator(session))
    except ValueError as error:
        if "more than 1 value per channel" not in str(error):
            raise
        raise InputError(
            f"data.batch_size={session.loading.batch_size}: {name_of(model)} normalises one value "
            "per channel of each batch, which has no variance; set a larger batch."
        ) from error
    for name, value in model.named_buffers():
        value.copy_(before[name])
    model.train(was_training)


def _try_external(session: Session, train_hw: tuple[int, int], test_hw: tuple[int, int]) -> None:
    """Call another author's network once per size of image, so that it is refused before a run.

    In training too, as its output may have another form there; its statistics do not change.
    """
    from rgbt.models.external.network import author_line  # most networks are of this package

    model = session.model
    before = {name: value.clone() for name, value in model.named_buffers()}
    for image_hw, is_training in ((train_hw, False), (test_hw, False), (train_hw, True)):
        model.train(is_training)
        count = min(2, session.loading.batch_size) if is_training else 1
        images = _black(session, count, image_hw)
        try:
            with torch.set_grad_enabled(is_training), session.autocast():
                output = model(*images, generator=_generator(session))
        except (InputError, torch.OutOfMemoryError):
            raise
        except Exception as error:
            size = " x ".join(map(str, image_hw))
            said = f"{type(error).__name__}: {one_line(error)}{author_line(error)}"
            raise InputError(
                f"model: the network cannot predict {count} images of {size} pixels ({said})."
            ) from error
    for name, value in model.named_buffers():
        value.copy_(before[name])
    if not output.logits.requires_grad:
        raise InputError(
            f"model.constructor={session.spec.model.values['constructor']}: the class scores have "
            "no gradient in training; choose others with model.train_scores."
        )
