"""Docstrings of the code as Markdown, read by griffe as mkdocstrings does."""

from __future__ import annotations

import inspect
import logging
from typing import Any

import griffe

logging.getLogger("griffe").setLevel(logging.ERROR)

OF_PARAMETERS = (griffe.DocstringSectionKind.parameters, griffe.DocstringSectionKind.attributes)


def summary(target: Any) -> str:
    """First paragraph of a docstring, in one line."""
    return " ".join((inspect.getdoc(target) or "").partition("\n\n")[0].split())


def description(target: Any) -> str:
    """What a docstring says before and beside its parameters, as Markdown."""
    return "\n\n".join(
        section.value if section.kind is griffe.DocstringSectionKind.text else _admonition(section)
        for section in _sections(target)
        if section.kind
        in (griffe.DocstringSectionKind.text, griffe.DocstringSectionKind.admonition)
    )


def _admonition(section: Any) -> str:
    return f"**{section.title or section.value.kind}**: {section.value.description}"


def parameters(target: Any) -> dict[str, str]:
    """Description of each parameter or attribute, also of those that a base class documents."""
    sources = reversed(target.__mro__) if inspect.isclass(target) else [target]
    return {
        item.name: item.description
        for source in sources
        for section in _sections(source)
        if section.kind in OF_PARAMETERS
        for item in section.value
    }


def _sections(target: Any) -> list[Any]:
    text = target.__doc__ if inspect.isclass(target) else inspect.getdoc(target)
    docstring = griffe.Docstring(inspect.cleandoc(text or ""), parser="google")
    return list(docstring.parse(warnings=False))
