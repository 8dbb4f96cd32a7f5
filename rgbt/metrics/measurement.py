"""What counts are of: whose predictions of which images, made and counted how.

A `Measurement` is made once, is stored inside its counts, and is compared as a value. File names,
conditions and labels are made of what differs from the test that a run ends with (`changed`).
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from rgbt.files.plain_files import parse_json
from rgbt.metrics.metric import Absent
from rgbt.types import VIEWS

# Statistics of batch normalisation (`rgbt.evaluation.batch_norm`): of the training, of all images,
# of the images by day and of the night apart, of each batch.
Statistics = Literal["as trained", "recomputed", "adabn", "batch"]

# Condition of the images as they are, predicted as the run is made for.
CLEAN = "clean"

# Titles of conditions.
TITLES = {
    "rgb": "RGB alone",
    "thermal": "thermal alone",
    "rgbt": "both images",
    "recomputed": "statistics recomputed",
    "adabn": "AdaBN",
    "batch": "statistics of the batch",
}

CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")  # characters that no text has

# Settings of a data set that say where its files are, or how counts are scored.
SAME_DATASET = tuple(f"dataset.{key}=" for key in ("root", "cache_dir", "absent", "unscored"))

HEADS = ("", "own", "source", "target")

# Characters of the changed settings in a file name.
LENGTH = 60


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One measurement; the fields of the second group are no part of its identity.

    Attributes:
        run: key of the run whose network predicted; "" for others.
        weights: SHA-256 of the file and of the settings of a network that is of no run; "" where
            nobody knows a network.
        checkpoint: of a run, "best" or "last".
        step: the optimiser step of the weights; 0 where none is known.
        dataset: fingerprint of the data set; `dataset_words` are the overrides that were typed for
            another one than that of the run.
        split: of the data set.
        view: the images that the network gets: "rgbt", "rgb" or "thermal".
        head: of a network with one per domain: "own", "source" or "target"; else "".
        partition: name of the regions ("ring5"), with the kind and the edges of details
            ("ring5-boundary-0.02"); of pairs of frames protocol and number of sets ("aligned3").
        statistics: of batch normalisation, and `statistics_of` the splits whose images they are
            computed from; (): the split itself.
        severity: of the corruption; 0 for clean images.
        settings: (key, value as JSON), sorted: `transform`, `prediction` and `trainer.precision` of
            the configuration, what the data set does to the pixels of its files, `corruption` with
            its seed; with other `statistics` also the size of a batch.

        absent: how a class without pixels scores (`rgbt.metrics.scores`), which is no count.
        changed: fields and keys of settings that differ from the test that the run ends with.
        dataset_name: of the data set, in names of files.
        corruption: name in files and tables: "noise_rgb", "occluded_block-16"; "" for none.
        title: of the corruption for people: "noise, RGB", and `unit` that of its severity.
    """

    run: str = ""
    weights: str = ""
    checkpoint: str = "best"
    step: int = 0
    dataset: str
    dataset_words: tuple[str, ...] = ()
    split: str
    view: str = ""
    head: str = ""
    partition: str
    statistics: Statistics = "as trained"
    statistics_of: tuple[str, ...] = ()
    severity: float = 0.0
    settings: tuple[tuple[str, str], ...] = ()
    absent: Absent = field(default="released", compare=False)
    changed: tuple[str, ...] = field(default=(), compare=False)
    dataset_name: str = field(default="", compare=False)
    corruption: str = field(default="", compare=False)
    title: str = field(default="", compare=False)
    unit: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        known = {"absent": get_args(Absent), "view": ("", *VIEWS), "head": HEADS}
        for key, words in known.items():
            if (found := getattr(self, key)) not in words:
                raise ValueError(
                    f"{key}: expected {', '.join(filter(None, words))}, got '{found}'."
                )
        if not math.isfinite(self.severity):
            raise ValueError(f"severity: expected a number, got {self.severity}.")

    @property
    def identity(self) -> dict[str, Any]:
        """Return the fields that decide the counts, as plain values."""
        return {key.name: getattr(self, key.name) for key in fields(self) if key.compare}

    @property
    def digest(self) -> str:
        """Return SHA-256 in hexadecimal of `identity`."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()

    def differences(self, other: Measurement) -> tuple[str, ...]:
        """Return the fields and keys of settings in which two measurements differ, sorted."""
        mine, others = self._values(), other._values()
        keys = sorted(mine.keys() | others.keys())
        return tuple(key for key in keys if mine.get(key) != others.get(key))

    def unlike(self, other: Measurement) -> tuple[str, ...]:
        """Say what differs between two measurements beside their networks: "view: rgb, rgbt".

        Of one network that is every difference. Of two networks it is what differs from the test
        that each ends with: as it is trained, each may see its images at another size.
        """
        mine, others = self._values(), other._values()
        is_same = (self.run, self.weights) == (other.run, other.weights)
        named = {*self.changed, *other.changed, "dataset"}
        if {self.statistics, other.statistics} != {"as trained"}:
            named |= {"statistics_of", "data.eval_batch_size"}
        found = []
        for key in self.differences(other):
            is_named = is_same or key in named or key.startswith("corruption.")
            is_network = key in ("run", "weights", "settings") or (key == "step" and not is_same)
            if is_named and not is_network:
                found.append(f"{key}: {_shown(mine.get(key))}, {_shown(others.get(key))}")
        return tuple(found)

    def _values(self) -> dict[str, Any]:
        return {**self.identity, **dict(self.settings), "settings": None}

    @property
    def is_own(self) -> bool:
        """Return whether it is what a run ends with, on this split."""
        return bool(self.run) and not self.changed

    @property
    def words(self) -> tuple[str, ...]:
        """Say what was changed, in words of conditions: ("thermal", "noise_rgb", "adabn")."""
        return (*self._names(), *self._changed_settings())

    def _names(self) -> list[str]:
        """`words` without the settings."""
        found = [self.view] if "view" in self.changed else []
        found += [self.partition] if "partition" in self.changed else []
        found += [self.corruption] if self.corruption else []
        found += [f"{self.head}-head"] if "head" in self.changed else []
        if self.statistics != "as trained":
            found += ["-".join((self.statistics, *self.statistics_of))]
        found += [f"last-{self.step}"] if self.checkpoint == "last" else []
        if "dataset" in self.changed:
            found += [f"{self.dataset_name.replace('/', '-')}-{self.dataset[:8]}"]
        found += [] if self.run or not self.weights else [f"weights-{self.weights[:8]}"]
        return found

    @property
    def condition(self) -> str:
        """Return `words` as one text, or "clean"; the severity is apart."""
        return " ".join(self.words) or CLEAN

    @property
    def label(self) -> str:
        """Say what was changed: "thermal alone · noise, RGB 16 (grey levels) · AdaBN"."""
        found = [TITLES[self.view]] if "view" in self.changed else []
        found += [self.partition] if "partition" in self.changed else []
        if self.corruption:
            found += [f"{self.title} {self.severity:g} ({self.unit})" if self.unit else self.title]
        found += [f"{self.head} head"] if "head" in self.changed else []
        if self.statistics != "as trained":
            of = f" of {', '.join(self.statistics_of)}" if self.statistics_of else ""
            found += [f"{TITLES[self.statistics]}{of}"]
        found += [f"last checkpoint, step {self.step}"] if self.checkpoint == "last" else []
        found += [self.dataset_name] if "dataset" in self.changed else []
        return " · ".join([*found, *self._changed_settings()])

    @property
    def file_name(self) -> str:
        """Name its file of counts, for people: "test_thermal_noise-16.npz".

        It is never read. With changed settings it ends with digits of the digest.
        """
        if self.is_own:
            return f"counts_{self.split}.npz"
        words = [self.split, *([] if self.run or "partition" in self.changed else [self.partition])]
        for word in self._names():
            is_corruption = self.unit and word == self.corruption
            words.append(f"{word}-{self.severity:.15g}" if is_corruption else word)
        if settings := self._changed_settings():
            words.append("_".join(word.rpartition(".")[2] for word in settings)[:LENGTH])
        # Values of settings, and other words for equal images, which the name may not tell apart.
        if self.dataset_words or any("." in key for key in self.changed):
            words.append(self.digest[:8])
        return "_".join(re.sub(r"[^\w.+-]+", "-", word).strip("-") for word in words) + ".npz"

    def _changed_settings(self) -> list[str]:
        """Changed settings as "key=value"; those of a corruption are in its name."""
        is_shown = {key for key in self.changed if not key.startswith("corruption.")}
        return [f"{key}={value}" for key, value in self.settings if key in is_shown]

    def to_json(self) -> str:
        """Write every field and the digest as JSON."""
        plain = {key.name: getattr(self, key.name) for key in fields(self)}
        return json.dumps({**plain, "digest": self.digest}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Measurement:
        """Read what `to_json` wrote; ValueError: something else, or with another digest."""
        plain = json.loads(text)
        digest = plain.pop("digest", None)
        found: Measurement = parse_json(json.dumps(plain), cls)
        if found.digest != digest:
            raise ValueError("the measurement does not match its digest")
        texts = [value for value in vars(found).values() if isinstance(value, str)]
        texts += [*found.statistics_of, *found.changed, *found.dataset_words]
        for pair in found.settings:
            texts += pair
        if any(CONTROL.search(text) for text in texts):
            raise ValueError("a text of the measurement has control characters")
        return found


def dataset_words(overrides: Iterable[str]) -> tuple[str, ...]:
    """Return the overrides that make a data set another one, not its folder or scored classes."""
    typed = (word for word in overrides if word.startswith("dataset"))
    return tuple(word for word in typed if not word.startswith(SAME_DATASET))


def _shown(value: Any) -> str:
    return "none" if value in (None, ()) else str(value)


def settings_of(values: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Turn values by dotted key into `Measurement.settings`."""
    return tuple(sorted((key, json.dumps(value, sort_keys=True)) for key, value in values.items()))
