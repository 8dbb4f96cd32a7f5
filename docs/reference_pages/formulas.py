"""Formulas: blocks ```math of LaTeX become MathML, which browsers show without a script."""

from __future__ import annotations

from typing import Any

from latex2mathml.converter import convert


def mathml(source: str, *_: Any, **__: Any) -> str:
    """A block of LaTeX as MathML, one formula a paragraph; the format of a custom fence."""
    formulas = [each for each in source.strip().split("\n\n") if each]
    return "".join(f"<p>{convert(each, display='block')}</p>" for each in formulas)
