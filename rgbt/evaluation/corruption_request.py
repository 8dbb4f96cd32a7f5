"""Parse a requested corruption: its file, changed settings, severity and seed.

``corruption=NAME`` names a file of ``conf/corruption/``, ``corruption=NAME:IMAGE`` sets its `image`
as well, and ``corruption=my.yaml`` names a file of your own; ``corruption.KEY=...`` changes a
setting, ``corruption.seed=1`` what is drawn.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from omegaconf import DictConfig, OmegaConf

from rgbt.build.contracts import check_corruption, check_sample, is_own
from rgbt.build.session import Session
from rgbt.checks import InputError, check_choice, split_list
from rgbt.config.component import build, constructor, setting_types
from rgbt.config.compose import conf_dir
from rgbt.config.stored_config import load_config
from rgbt.corruptions.corruption import Corruption, OfTime
from rgbt.data.to_predict import ToPredict
from rgbt.evaluation.corrupted_dataset import CorruptedDataset, corrupt, settings_of
from rgbt.files.yaml_files import parse_yaml
from rgbt.spec.corruption_names import row_name

NODE = "corruption"
SEED = "seed"
"""The only key below `NODE` that is not a setting of a file: the seed of all random draws."""


@dataclass(frozen=True)
class CorruptionRequest:
    """A corruption with a severity; 0: the images as they are.

    Attributes:
        name: its name in files of counts, without changes, such as "noise_rgb".
        changes: ``key=value`` words that differ from the file, as typed.
        seed: of what is drawn.
    """

    name: str
    corruption: Corruption
    changes: tuple[str, ...] = ()
    seed: int = 0
    severity: float = 0.0

    @property
    def row(self) -> str:
        """The name that all its severities share: "occluded", or "occluded_block-16" if changed."""
        return self._with_changes(self.name)

    @property
    def file_stem(self) -> str:
        """For file names: "occluded-0.5", or "occluded-0.5_block-16" where that was changed."""
        return self._with_changes(f"{self.name}-{self.severity:g}")

    @property
    def title(self) -> str:
        """For people: "occluded, thermal 0.5 (share of blocks)"."""
        kind = self.corruption
        return f"{kind.title} {self.severity:g} ({kind.unit})" if kind.unit else kind.title

    def _with_changes(self, first: str) -> str:
        drawn = [f"seed={self.seed}"] if self.seed else []
        return "_".join(re.sub(r"[^\w.]+", "-", word) for word in (first, *self.changes, *drawn))

    def ladder(self) -> tuple[CorruptionRequest, ...]:
        """The same at each severity of its ladder."""
        return tuple(replace(self, severity=each) for each in self.corruption.severities)

    def at(self, severity: str) -> CorruptionRequest:
        """The same at the severity that was typed; a ladder of one needs none.

        Raises:
            InputError: not a number, out of range, or missing where the ladder has several.
        """
        ladder = self.corruption.severities
        if not severity and len(ladder) == 1:
            return replace(self, severity=ladder[0])
        try:
            value = float(severity)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            unit = self.corruption.unit or "1 is the only one"
            known = ", ".join(f"{each:g}" for each in ladder)
            raise InputError(
                f"severity={severity}: corruption={self.name} requires a number ({unit}), for "
                f"example one of {known}."
            )
        if value:
            self.corruption.check(value)
        return replace(self, severity=value)

    def identity(self) -> dict[str, Any]:
        """The settings that determine the images, as JSON values."""
        return {
            "degradation": self.name,  # the key that counts on disk are found by
            "kind": type(self.corruption).__name__,
            "settings": settings_of(self.corruption),
            "severity": self.severity,
            "seed": self.seed,
        }

    def applied_to(self, session: Session, split: str) -> Session:
        """`session` that reads `split` under this corruption."""
        kind = self.corruption
        dataset = self.dataset(session, split)
        if is_own(kind) and not isinstance(kind, OfTime):
            first = dataset.names(split)[0]
            returned = f"corruption: {type(kind).__name__}.__call__ returned"
            check_sample(returned, dataset.read(first), first)
        return replace(session, dataset=dataset)

    def dataset(self, session: Session, split: str) -> CorruptedDataset:
        """The data set of `session`, of which `split` is read under this corruption."""
        return CorruptedDataset(
            session.dataset, self.corruption, self.severity, split=split, seed=self.seed
        )

    def images(self, images: ToPredict, session: Session, source: str) -> ToPredict:
        """`images` under this corruption.

        Args:
            images: those of `source`.
            session: with the data set of the network.
            source: a split of the data set, or anything else, such as a folder.

        Raises:
            InputError: a corruption of time, and images without the order of a split.
        """
        read, kind = images.read, self.corruption
        if source in session.dataset.splits:
            dataset = self.dataset(session, source)
            return replace(images, read=lambda name: dataset.corrupted(name, read))
        if not self.severity:
            return images
        if isinstance(kind, OfTime):
            raise InputError(
                f"corruption={self.name} shows an earlier frame of the split, but these images are "
                f"no split of {session.dataset.name}; predict a split, or choose another "
                "corruption."
            )
        return replace(
            images, read=lambda name: corrupt(name, read(name), kind, self.severity, self.seed)
        )


def standard_corruptions() -> list[str]:
    """Every file of ``conf/corruption/`` with each image that its class can corrupt.

    In the order of their rows: blur, blur:rgb, blur:thermal, delayed, ...
    """
    found = []
    for path in (conf_dir() / NODE).glob("*.yaml"):
        types = setting_types(constructor(_node(path, ())["_target_"], NODE))
        images = get_args(types["image"]) if "image" in types else ()
        found += [path.stem if each == "both" else f"{path.stem}:{each}" for each in images]
        found += [] if images else [path.stem]
    return sorted(found, key=row_name)


def choose_corruption(
    name: str, words: Sequence[str] = (), trust: Collection[str] = ()
) -> CorruptionRequest:
    """The corruption called `name`, at severity 0.

    Args:
        name: a file of ``conf/corruption/`` without extension, alone or as NAME:IMAGE, or a path
            that ends in .yaml.
        words: ``corruption.KEY=VALUE``.
        trust: modules that the file may name (`rgbt.config.stored_config`).

    Raises:
        InputError: no such file or key, or a value that does not fit.
    """
    is_file = name.endswith((".yaml", ".yml"))
    stem, _, image = (name, "", "") if is_file else name.partition(":")
    if not is_file:
        check_choice(NODE, stem, sorted(path.stem for path in (conf_dir() / NODE).glob("*.yaml")))
    path = Path(name).expanduser() if is_file else conf_dir() / NODE / f"{stem}.yaml"
    pairs = [word.removeprefix(f"{NODE}.").partition("=")[::2] for word in words]
    pairs = [*([("image", image)] if image else []), *pairs]
    node = _node(path, trust)
    for key, value in pairs:
        if key != SEED:
            OmegaConf.update(node, key, parse_yaml(value, f"{NODE}.{key}"))
    seed = dict(pairs).get(SEED, "0")
    if not seed.isdecimal():
        raise InputError(f"{NODE}.{SEED}={seed}: expected a whole number of at least 0.")
    corruption = build(node)
    if is_own(corruption) and not isinstance(corruption, OfTime):
        check_corruption(corruption)
    # The image is part of the name of a shipped file, and a change of a user's file.
    unnamed = ("severities", SEED) if is_file else ("severities", SEED, "image")
    return CorruptionRequest(
        name=path.stem if is_file else row_name(f"{stem}:{node.get('image', '')}"),
        corruption=corruption,
        changes=tuple(f"{key}={value}" for key, value in pairs if key not in unnamed),
        seed=int(seed),
    )


def requested_corruption(
    name: str, severity: str, words: Sequence[str], trust: Collection[str]
) -> CorruptionRequest | None:
    """The corruption of ``corruption=`` and ``severity=``; None for "none".

    Raises:
        InputError: see `choose_corruption`; a severity or `words` without a corruption.
    """
    if name != "none":
        return choose_corruption(name, words, trust).at(severity)
    idle = [*(["severity"] if severity else []), *words]
    if idle:
        key = idle[0].partition("=")[0]
        raise InputError(f"'{key}' has no effect without corruption=..., for example noise.")
    return None


def choose_corruptions(
    text: str, words: Sequence[str], trust: Collection[str] = ()
) -> list[CorruptionRequest]:
    """The corruptions of ``corruptions=``: names with commas, or "all".

    `words` are any key of a single corruption, the seed of several.

    Raises:
        InputError: an unknown name, one given twice, or keys of several corruptions at once.
    """
    names = split_list(text, "corruptions")
    names = standard_corruptions() if names == ["all"] else names
    for word in words:
        key = word.partition("=")[0]
        if len(names) > 1 and key != f"{NODE}.{SEED}":
            raise InputError(
                f"'{key}' is a setting of a single corruption, but {len(names)} were requested. "
                "Name one corruption with corruptions=..."
            )
    chosen = [choose_corruption(name, words, trust) for name in names]
    rows = [each.name for each in chosen]
    for row in rows:
        if rows.count(row) > 1:
            raise InputError(f"corruptions: '{row}' is given twice; name each corruption once.")
    return chosen


def split_overrides(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Overrides below ``corruption``, and the others."""
    own = [word for word in overrides if word.startswith(f"{NODE}.")]
    return own, [word for word in overrides if word not in own]


def _node(path: Path, trust: Collection[str]) -> DictConfig:
    if not path.is_file():
        raise InputError(f"{NODE}={path}: the file does not exist.")
    # Below its key, so that sentences about it say corruption.block and not block.
    node = OmegaConf.create({NODE: load_config(path, trust)})[NODE]
    assert isinstance(node, DictConfig), "load_config returns a mapping"
    return node
