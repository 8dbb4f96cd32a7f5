"""Scores in percent, as MLflow and tables of results show them."""

from __future__ import annotations

from rgbt.metrics import names

FRACTIONS = {names.MIOU, names.MACC, names.MPRECISION, names.MF1, names.PIXEL_ACCURACY}


def in_percent(name: str, value: float) -> float:
    """A score in percent with all its digits; Var and what is no score keep their unit.

    Example:
        >>> in_percent("day/mIoU", 0.5), in_percent("Var", 12.5), in_percent("loss", 0.5)
        (50.0, 12.5, 0.5)
    """
    return 100 * value if _is_fraction(name) else value


def shown(name: str, value: float) -> float:
    """A value as MLflow shows it: scores in percent with two decimals, as the papers print them.

    Its charts write 0.62 for a fraction, and its tables all sixteen digits. The folder keeps the
    exact value.
    """
    is_score = _is_fraction(name) or name.split("/")[-1] == names.VAR
    return round(in_percent(name, value), 2) if is_score else value


def _is_fraction(name: str) -> bool:
    first, last = name.split("/")[0], name.split("/")[-1]
    return last in FRACTIONS or first in ("region", "class", names.TC, names.CA)
