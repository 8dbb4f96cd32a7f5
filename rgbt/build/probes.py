"""Checks on one sample and one mask, made before a run starts."""

from __future__ import annotations

import torch

from rgbt.build.contracts import check_first_sample, check_regions, check_transform, is_own
from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.dataset import reader_of
from rgbt.geometry.camera import Camera
from rgbt.maskers.contract import check_masker
from rgbt.models.external.network import ExternalNetwork
from rgbt.randomness import numpy_generator, torch_generator
from rgbt.requirements import record_of
from rgbt.types import AnyMasker, Sample


def first_readable(session: Session, split: str) -> Sample:
    """The first sample of a split; unreadable ones are passed over where the run does so too."""
    refused: InputError | None = None
    for name in session.dataset.names(split):
        try:
            return session.dataset.read(name)
        except InputError as error:
            if session.loading.on_error == "raise":
                raise
            refused = refused or error
    assert refused is not None, "a split holds a name"
    raise refused


def example_hw(session: Session) -> tuple[int, int]:
    """Size of the first training example."""
    sample = first_readable(session, session.domains.source.split)
    example = session.transform.train(sample, numpy_generator(session.spec.seed, "probe"))
    height, width = example.thermal.shape
    return height, width


def check_own_parts(session: Session) -> None:
    """Refuse a user's data set, transform or partition that does not do what it must."""
    dataset, transform = reader_of(session.dataset), session.transform
    splits = [domain.split for domain in session.domains.named.values()]
    if is_own(dataset):
        for split in dict.fromkeys(filter(None, (*splits, session.selection_split, "test"))):
            check_first_sample(dataset, split)
    if is_own(transform):
        sample = first_readable(session, splits[0])
        check_transform(transform, sample, numpy_generator(session.spec.seed, "probe"))
    if is_own(session.regions):
        check_regions(session.regions, first_readable(session, "test").thermal.shape)


def check_external(session: Session) -> None:
    """Call another author's network once per size of image, so that it is refused before a run.

    In training too, as its output may have another form there; its statistics do not change.

    Raises:
        InputError: it refuses the images, returns something else, or scores without gradients.
    """
    model = session.model
    if not isinstance(model, ExternalNetwork):
        return
    shown = session.transform.test(first_readable(session, "test"))
    train_hw = example_hw(session)
    model.eval()
    for hw in dict.fromkeys((train_hw, shown.thermal.shape)):
        with torch.no_grad(), session.fabric.autocast():
            model(*_black(session, 1, hw))
    before = {name: value.clone() for name, value in model.named_buffers()}
    model.train()
    with session.fabric.autocast():
        images = _black(session, min(2, session.loading.batch_size), train_hw)
        drawn = torch_generator(session.spec.seed, "probe")
        learns = model(*images, generator=drawn).logits.requires_grad
    for name, value in model.named_buffers():
        value.copy_(before[name])
    if not learns:
        raise InputError(
            f"model.constructor={model.constructor}: the class scores of the network have no "
            "gradient in training, so that it cannot be trained; remove .detach(), torch.no_grad() "
            "or the conversion of its output, or choose other scores with model.train_scores."
        )


def _black(session: Session, count: int, hw: tuple[int, ...]) -> list[torch.Tensor]:
    device = session.fabric.device
    return [torch.zeros(count, channels, *hw, device=device) for channels in (3, 1)]


def check_cells(session: Session, masker: AnyMasker) -> None:
    """Draw one mask, so that cells that do not fit the crop are refused before the run starts."""
    crop_hw = record_of(session.transform).crop_hw
    if crop_hw is None and is_own(masker):
        crop_hw = example_hw(session)
    if crop_hw is not None and record_of(masker).hides_cells:
        check_masker(masker, crop_hw, torch_generator(session.spec.seed, "probe"))


def check_cameras(session: Session, scheme: object) -> None:
    """Refuse the camera of other images: of a scheme of two frames, and of consistency."""
    camera = record_of(scheme).camera
    if camera is not None:
        _check_camera("scheme", camera, example_hw(session))
    if session.consistency.sets:
        shown = session.transform.test(first_readable(session, "test"))
        for image in (shown.rgb, shown.label):
            _check_camera("consistency", session.consistency.view.camera, image.shape[:2])


def _check_camera(node: str, camera: Camera, image_hw: tuple[int, int]) -> None:
    try:
        camera.matrix(image_hw)
    except InputError as error:
        raise InputError(f"{node}.view.{error}") from error
