"""Copy the state of a training to memory of the host, so that a thread can write it.

The memory is used again by every copy. It is shared with forked loader processes: of private
memory, the system would copy each page that is written after a fork.
"""

from __future__ import annotations

import copy
import ctypes
import mmap
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import torch
from torch import Tensor

# Bytes to whose multiples the copies of tensors are aligned.
ALIGNMENT = 64

# The copies, by the keys under which a nested state has their tensors.
Copies = dict[tuple[Hashable, ...], Tensor]


def copied(state: Any, copies: Copies) -> Any:
    """Copy `state`, of nested mappings and lists, into `copies`; what they lack is added.

    The next call with the same `copies` replaces the tensors of this one.
    """
    reserve(state, copies)
    found = _copied(state, copies, ())
    if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        torch.cuda.synchronize()  # copies to pinned memory do not wait
    return found


def reserve(state: Any, copies: Copies) -> Callable[[], object]:
    """Add what `copies` lack for `state`, uninitialised.

    Returns what gets their memory from the system, which takes longer than a copy: call it in a
    thread.
    """
    missing = {}
    for keys, tensor in _tensors(state, ()):
        held = copies.get(keys)
        if held is None or (held.shape, held.dtype) != (tensor.shape, tensor.dtype):
            missing[keys] = tensor
    sizes = [-(-tensor.nbytes // ALIGNMENT) * ALIGNMENT for tensor in missing.values()]
    if not missing:
        return lambda: None
    memory = _memory(sum(sizes) or 1, pinned=any(tensor.is_cuda for tensor in missing.values()))
    start = 0
    for (keys, tensor), size in zip(missing.items(), sizes, strict=True):
        form = torch.empty_like(tensor, device="meta")
        flat = torch.empty(0, dtype=form.dtype)
        if size:  # each has a storage of its own, as in a file of torch.save
            flat = torch.frombuffer(memory, dtype=form.dtype, count=form.numel(), offset=start)
        copies[keys] = flat.as_strided(form.shape, form.stride())
        start += size
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    return lambda: ctypes.memset(address, 0, len(memory))


def _memory(size: int, *, pinned: bool) -> Any:
    """A writable buffer of this many bytes, which a GPU copies to without a detour if `pinned`."""
    if pinned:
        return torch.empty(size, dtype=torch.uint8, pin_memory=True).numpy()
    return mmap.mmap(-1, size)


def _tensors(
    state: Any, keys: tuple[Hashable, ...]
) -> Iterator[tuple[tuple[Hashable, ...], Tensor]]:
    if isinstance(state, Tensor):
        yield keys, state
    elif isinstance(state, dict | list):
        for key, value in state.items() if isinstance(state, dict) else enumerate(state):
            yield from _tensors(value, (*keys, key))


def _copied(state: Any, copies: Copies, keys: tuple[Hashable, ...]) -> Any:
    if isinstance(state, Tensor):
        held = copies[keys]
        if state.device.type == "cpu" and state.stride() == held.stride():
            # One thread, because the threads of a parallel copy wait for each other at each tensor.
            ctypes.memmove(held.data_ptr(), state.data_ptr(), state.nbytes)
            return held
        return held.copy_(state.detach(), non_blocking=True)
    if not isinstance(state, dict | list):
        return state
    found = copy.copy(state)  # of weights, with the versions of their modules
    for key, value in state.items() if isinstance(state, dict) else enumerate(state):
        found[key] = _copied(value, copies, (*keys, key))
    return found
