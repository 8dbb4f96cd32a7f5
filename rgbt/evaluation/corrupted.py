"""A failure that a command was asked for: chosen, with its severity, and put in front of a session.

``degradation=NAME`` names a file of ``conf/degradation/``, or one of your own (``my.yaml``);
``degradation.KEY=...`` changes a value of it, ``degradation.seed=1`` what is drawn.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.build.contracts import check_degradation, check_sample, is_own
from rgbt.build.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.config.component import build
from rgbt.config.compose import conf_dir
from rgbt.config.stored_config import load_config
from rgbt.corruptions.corruption import Degradation, OfTime
from rgbt.corruptions.dataset import Degraded, settings_of
from rgbt.files.yaml_files import parse_yaml

NODE = "degradation"
SEED = "seed"
"""The one key below `NODE` that is no setting of a file: all files are drawn from it."""


@dataclass(frozen=True)
class Chosen:
    """A degradation as it was asked for, without a severity.

    Attributes:
        name: its file without extension.
        degradation: built.
        changes: ``key=value`` words that differ from the file, as typed.
        seed: of what is drawn.
    """

    name: str
    degradation: Degradation
    changes: tuple[str, ...] = ()
    seed: int = 0

    @property
    def row(self) -> str:
        """What all its severities share: "occluded", or "occluded_block-16" where changed."""
        return self.mark(self.name)

    def mark(self, first: str) -> str:
        """`first` and what was changed, as part of a file's name."""
        drawn = [f"seed={self.seed}"] if self.seed else []
        return "_".join(re.sub(r"[^\w.]+", "-", word) for word in (first, *self.changes, *drawn))

    def at(self, text: str) -> Failure:
        """With the severity that was typed; the only one of the ladder may be left out.

        Raises:
            InputError: no number, out of range, or left out where there are several.
        """
        ladder = self.degradation.severities
        if not text and len(ladder) == 1:
            return Failure(self, ladder[0])
        known = ", ".join(f"{each:g}" for each in ladder)
        try:
            found = float(text)
        except ValueError:
            found = math.nan
        if not math.isfinite(found):
            unit = self.degradation.unit or "1 is the only one"
            raise InputError(
                f"severity={text}: degradation={self.name} needs a number ({unit}), for example "
                f"one of {known}."
            )
        if found:
            self.degradation.check(found)
        return Failure(self, found)


@dataclass(frozen=True)
class Failure:
    """A degradation with a severity."""

    chosen: Chosen
    severity: float

    @property
    def mark(self) -> str:
        """For file names: "occluded-0.5", or "occluded-0.5_block-16" where that was changed."""
        return self.chosen.mark(f"{self.chosen.name}-{self.severity:g}")

    @property
    def told(self) -> str:
        """For people: "occluded, thermal 0.5 (share of blocks)"."""
        kind = self.chosen.degradation
        return f"{kind.title} {self.severity:g} ({kind.unit})" if kind.unit else kind.title

    def identity(self) -> dict[str, Any]:
        """What decides how the images look, as values of JSON."""
        return {
            "degradation": self.chosen.name,
            "kind": type(self.chosen.degradation).__name__,
            "settings": settings_of(self.chosen.degradation),
            "severity": self.severity,
            "seed": self.chosen.seed,
        }

    def applied(self, session: Session, split: str) -> Session:
        """`session` that reads `split` under this failure."""
        kind, seed = self.chosen.degradation, self.chosen.seed
        seen = Degraded(session.dataset, kind, self.severity, split=split, seed=seed)
        if is_own(kind) and not isinstance(kind, OfTime):
            first = seen.names(split)[0]
            returned = f"degradation: {type(kind).__name__}.__call__ returned"
            check_sample(returned, seen.read(first), first)
        return replace(session, dataset=seen)


def known_degradations() -> list[str]:
    """Names of the files of ``conf/degradation/``."""
    return sorted(path.stem for path in (conf_dir() / NODE).glob("*.yaml"))


def choose(name: str, words: Sequence[str] = (), trust: Collection[str] = ()) -> Chosen:
    """The degradation called `name`.

    Args:
        name: a file of ``conf/degradation/`` without extension, or a path that ends in .yaml.
        words: ``degradation.KEY=VALUE``, as `own_words` finds them.
        trust: modules that the file may name (`rgbt.config.stored_config`).

    Raises:
        InputError: no such file or key, or a value that does not fit.
    """
    is_file = name.endswith((".yaml", ".yml"))
    if not is_file:
        check_choice(NODE, name, known_degradations())
    path = Path(name).expanduser() if is_file else conf_dir() / NODE / f"{name}.yaml"
    pairs = [word.removeprefix(f"{NODE}.").partition("=")[::2] for word in words]
    node = _node(path, trust)
    for key, value in pairs:
        if key != SEED:
            OmegaConf.update(node, key, parse_yaml(value, f"{NODE}.{key}"))
    kind = build(node)
    if is_own(kind) and not isinstance(kind, OfTime):
        check_degradation(kind)
    return Chosen(
        name=path.stem,
        degradation=kind,
        changes=tuple(f"{key}={value}" for key, value in pairs if key not in (SEED, "severities")),
        seed=_seed([value for key, value in pairs if key == SEED]),
    )


def own_words(overrides: Sequence[str]) -> tuple[list[str], list[str]]:
    """Overrides below ``degradation``, and the others."""
    own = [word for word in overrides if word.startswith(f"{NODE}.")]
    return own, [word for word in overrides if word not in own]


def _node(path: Path, trust: Collection[str]) -> DictConfig:
    if not path.is_file():
        raise InputError(f"degradation={path}: there is no such file.")
    # Below its key, so that sentences about it say degradation.block and not block.
    node = OmegaConf.create({NODE: load_config(path, trust)})[NODE]
    assert isinstance(node, DictConfig), "load_config returns a mapping"
    return node


def _seed(typed: Sequence[str]) -> int:
    text = typed[-1] if typed else "0"
    if not text.isdecimal():
        raise InputError(f"{NODE}.{SEED}={text}: expected a whole number of at least 0.")
    return int(text)
