"""Images under a corruption, in the place of those of a data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rgbt.assembly.contracts import check_sample, is_own
from rgbt.assembly.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.config.component import build
from rgbt.config.corruption_node import ChosenCorruption, choose_corruption
from rgbt.config.values import check_value
from rgbt.corruptions.kinds import Corruption, OfTime
from rgbt.data.new_images import ToPredict
from rgbt.dataset import DatasetWrapper, LabelledDataset
from rgbt.files.yaml_files import parse_yaml
from rgbt.randomness import numpy_generator
from rgbt.types import Sample


class CorruptedDataset(DatasetWrapper):
    """`source` under a corruption; `split` gives the order of time.

    Names, labels and the fingerprint are those of the source: scores refer to the same images.
    Random draws for an image depend only on (seed, image name). Severity 0: the images as they are.
    """

    def __init__(
        self, source: LabelledDataset, chosen: ChosenCorruption, severity: float, split: str
    ) -> None:
        super().__init__(source)
        self.chosen, self.severity = chosen, severity
        self.corruption = corruption_of(chosen)
        self._earlier: dict[str, str] = {}
        if severity:
            self.corruption.check(severity)
        if severity and isinstance(self.corruption, OfTime):
            names = source.names(split)
            nights = source.nights(names) or (False,) * len(names)
            for dark in (False, True):
                frames = [name for name, night in zip(names, nights, strict=True) if night == dark]
                for index, name in enumerate(frames):
                    self._earlier[name] = frames[self.corruption.shown(index, severity)]

    def read(self, name: str) -> Sample:
        """Read the sample called `name` under the corruption; errors are those of `corrupted`."""
        return self.corrupted(name, self.source.read)

    def corrupted(self, name: str, read: Callable[[str], Sample]) -> Sample:
        """Put what `read` returns of `name` under the corruption.

        Raises:
            InputError: as `read`; an image that is not of the split, or of another size than the
                frame that it shows; a severity that changes nothing of an image of this size.
        """
        sample = read(name)
        if not self.severity:
            return sample
        if isinstance(self.corruption, OfTime):
            if name not in self._earlier:
                raise InputError(f"'{name}' is not in the split whose order says what it shows.")
            other = read(self._earlier[name])
            if other.thermal.shape != sample.thermal.shape:
                raise InputError(f"'{name}' and '{other.name}', which it shows, differ in size.")
            return replace(sample, thermal=other.thermal)

        def rng_of(purpose: str) -> np.random.Generator:
            # This word is part of the seed and must not change.
            return numpy_generator(self.chosen.node["seed"], f"degradation {purpose} of {name}")

        return self.corruption(sample, self.severity, rng_of)


def corruption_of(chosen: ChosenCorruption) -> Corruption:
    """Build the corruption of these settings; InputError: a value that does not fit."""
    made: Corruption = build({key: v for key, v in chosen.node.items() if key != "seed"})
    return made


def severity_of(chosen: ChosenCorruption, text: str) -> float:
    """Return the severity that was typed; none is needed where there is one to choose from."""
    corruption = corruption_of(chosen)
    if not text and len(corruption.severities) == 1:
        return corruption.severities[0]
    severity: float = check_value("severity", parse_yaml(text, "severity"), float)
    if severity:
        corruption.check(severity)
    return severity


def corrupted(session: Session, chosen: ChosenCorruption, severity: float, split: str) -> Session:
    """Return a session that reads `split` under a corruption."""
    dataset = CorruptedDataset(session.dataset, chosen, severity, split)
    kind = dataset.corruption
    if is_own(kind) and not isinstance(kind, OfTime):
        first = session.dataset.names(split)[0]
        returned = f"corruption: {type(kind).__name__}.__call__ returned"
        check_sample(returned, dataset.read(first), first)
    return replace(session, dataset=dataset)


def corrupted_images(
    images: ToPredict, session: Session, chosen: ChosenCorruption, severity: float, source: str
) -> ToPredict:
    """Put `images` of `source` under a corruption; one of time needs a split as source."""
    dataset, read = session.dataset, images.read
    if isinstance(corruption_of(chosen), OfTime):
        check_choice("input", source, dataset.splits)
    # Corruptions of pixels do not depend on the split.
    split = source if source in dataset.splits else next(iter(dataset.splits))
    changed = CorruptedDataset(dataset, chosen, severity, split)
    return replace(images, read=lambda name: changed.corrupted(name, read))


def requested_corruption(
    name: str, severity: str, words: Sequence[str], trust: Sequence[str]
) -> tuple[ChosenCorruption, float] | None:
    """Return the corruption of ``corruption=`` and its severity; None for "none"."""
    if name == "none":
        if severity or words:
            raise InputError(f"corruption=none: {['severity', *words][-1]} has no effect.")
        return None
    chosen = choose_corruption(name, words, trust)
    return chosen, severity_of(chosen, severity)
