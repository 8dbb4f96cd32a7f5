"""Small functions that a training may compile, so that what is read once is not written first.

`fused` marks them; `compile_fused` switches them for the process. They are compiled at their first
call, for shapes of any size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import torch

from rgbt.checks import InputError, one_line

Given = ParamSpec("Given")
Found = TypeVar("Found")

_is_compiled = False


def fused(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Let a function of tensors be compiled by `torch.compile` inside `compile_fused`."""

    @cache
    def compiled() -> Callable[Given, Found]:
        made: Callable[Given, Found] = torch.compile(function, dynamic=True)
        return made

    @wraps(function)
    def call(*arguments: Given.args, **keywords: Given.kwargs) -> Found:
        if not _is_compiled or torch.compiler.is_compiling():
            return function(*arguments, **keywords)
        try:
            return compiled()(*arguments, **keywords)
        except Exception as error:
            if not type(error).__module__.startswith("torch._"):  # such as a lack of memory
                raise
            said = f"{function.__name__} cannot be compiled ({one_line(error)})"
            raise InputError(f"trainer.compile: {said}; set trainer.compile=none.") from error

    return call


@contextmanager
def compile_fused(is_wanted: bool) -> Iterator[None]:
    """Compile the marked functions in this block, or call them as they are."""
    global _is_compiled
    before, _is_compiled = _is_compiled, is_wanted
    try:
        yield
    finally:
        _is_compiled = before
