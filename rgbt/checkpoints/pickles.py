"""Pickles as data: a reader of the opcodes that has no way to call what a file names.

Python's own unpickler imports the objects that a file names and calls them. Here a name stays a
`Name`; what a file wants called is looked up among the few builders of `rgbt.checkpoints.builders`,
which put together inert values of ours. Every other name is refused where it occurs, called or not.
"""

from __future__ import annotations

import os
import pickletools
from collections.abc import Callable, Mapping
from typing import IO, Any

from rgbt.checkpoints.builders import PLAIN_NAMES, STAND_INS, Builder
from rgbt.checkpoints.records import (
    Array,
    DamagedError,
    Inert,
    Name,
    NumberType,
    RefusedError,
    check_key,
)

Persistent = Callable[[Any], Any]

GROWTH, SMALL = 8, 1_000_000
"""What may be copied while reading: so many times the bytes of the file, and a little more."""

SENSELESS = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError),
    *(MemoryError, RecursionError),
)
"""What opcodes in an order that nobody writes lead to."""

SIZED = (str, bytes, bytearray, list, tuple, dict, set, frozenset)


def unpickle(stream: IO[bytes], builders: Mapping[str, Builder], persistent: Persistent) -> Any:
    """The value of the next pickle in `stream`; the stream is left right behind it.

    Args:
        stream: bytes, read from its position.
        builders: full name in the file -> what makes a value of the arguments.
        persistent: makes a value of what the file refers to outside the pickle.

    Raises:
        RefusedError: a name or opcode that is not among the known ones.
        DamagedError: not a pickle, cut short, or senseless.
    """
    start = stream.tell()
    stream.seek(0, os.SEEK_END)
    machine = Machine(builders, persistent, budget=GROWTH * stream.tell() + SMALL)
    stream.seek(start)
    try:
        for opcode, argument, _ in pickletools.genops(stream):
            step = STEPS.get(opcode.name)
            if step is None:
                raise RefusedError(
                    f"uses the pickle opcode {opcode.name}, which no checkpoint needs."
                )
            step(machine, argument)
        return machine.stack.pop()
    except SENSELESS as error:
        raise DamagedError from error


class Machine:
    """Stack, marks and memo of one pickle. Values on the stack are plain Python or `records`."""

    def __init__(
        self, builders: Mapping[str, Builder], persistent: Persistent, *, budget: int
    ) -> None:
        self.builders = builders
        self.persistent = persistent
        self.budget = budget
        self.stack: list[Any] = []
        self.marks: list[list[Any]] = []
        self.memo: dict[int, Any] = {}

    def push(self, value: Any) -> None:
        """Onto the stack."""
        self.stack.append(value)

    def mark(self, _: object) -> None:
        """Begin a new stack on top of this one."""
        self.marks.append(self.stack)
        self.stack = []

    def since_mark(self) -> list[Any]:
        """What lies above the last mark, which is taken away."""
        items, self.stack = self.stack, self.marks.pop()
        return items

    def name(self, module: object, name: object) -> None:
        """Push a name.

        Raises:
            RefusedError: unknown.
        """
        if not isinstance(module, str) or not isinstance(name, str):
            raise TypeError("a name is text")
        full = f"{module}.{name}"
        if full not in self.builders and full not in PLAIN_NAMES and full not in STAND_INS:
            raise RefusedError.code(full)
        self.push(Name(full))

    def call(self, callee: object, arguments: object) -> None:
        """Push what a builder of ours, or an inert stand-in, makes of the arguments.

        Raises:
            RefusedError: there is none for `callee`.
        """
        if not isinstance(callee, Name) or not isinstance(arguments, tuple):
            raise TypeError("only names are called, with a tuple")
        self.spend(arguments)
        if callee.full in STAND_INS:
            self.push(Inert(callee.full))
        elif callee.full in self.builders:
            self.push(self.builders[callee.full](*arguments))
        else:
            raise RefusedError.code(callee.full)

    def build(self, _: object) -> None:
        """Hand a state to the value below it; only our own records take one."""
        state, target = self.stack.pop(), self.stack[-1]
        self.spend(state if isinstance(state, tuple) else (state,))
        if isinstance(target, Inert | Array | NumberType):
            target.build(state)
        elif type(target) is not dict:  # attributes of an ordered dictionary mean nothing here
            raise TypeError(f"{type(target).__name__} takes no state")

    def spend(self, values: tuple[Any, ...]) -> None:
        """Count what is about to be copied, which a file may ask for over and over.

        Raises:
            RefusedError: it is far more than the file holds.
        """
        self.budget -= sum(len(value) for value in values if isinstance(value, SIZED))
        if self.budget < 0:
            raise RefusedError.greedy()

    def extend(self, items: list[Any]) -> None:
        """Append to a list."""
        target = self.stack[-1]
        if type(target) is not list and not isinstance(target, Inert):
            raise TypeError("only lists are appended to")
        target.extend(items)

    def update(self, items: list[Any]) -> None:
        """Set keys of a dictionary: key, value, key, value, ..."""
        target = self.stack[-1]
        if type(target) is not dict and not isinstance(target, Inert):
            raise TypeError("only dictionaries have keys")
        target.update(_pairs(items))

    def add(self, _: object) -> None:
        """Add to a set."""
        items, target = self.since_mark(), self.stack[-1]
        if type(target) is not set:
            raise TypeError("only sets are added to")
        target.update(map(check_key, items))

    def take(self, count: int) -> list[Any]:
        """The topmost `count` values, taken away."""
        if len(self.stack) < count:
            raise IndexError("too few values")
        items = self.stack[-count:]
        del self.stack[-count:]
        return items


def _pairs(items: list[Any]) -> dict[Any, Any]:
    return {check_key(k): v for k, v in zip(items[::2], items[1::2], strict=True)}


def _instance(machine: Machine, argument: str) -> None:
    """INST: "module name" in the opcode, arguments above the mark."""
    arguments = tuple(machine.since_mark())
    machine.name(*argument.split(" ", 1))
    machine.call(machine.stack.pop(), arguments)


def _object(machine: Machine, _: object) -> None:
    """OBJ: class and arguments above the mark."""
    callee, *arguments = machine.since_mark()
    machine.call(callee, tuple(arguments))


def _new_object_ex(machine: Machine, _: object) -> None:
    callee, arguments, keywords = machine.take(3)
    if keywords and not (isinstance(callee, Name) and callee.full in STAND_INS):
        raise TypeError("no builder takes keywords")
    machine.call(callee, arguments)


def _pop(machine: Machine, _: object) -> None:
    if machine.stack:
        machine.stack.pop()
    else:
        machine.since_mark()


Step = Callable[[Machine, Any], object]


def _makes(make: Callable[[], object]) -> Step:
    return lambda machine, _: machine.push(make())


def _collects(make: Callable[[list[Any]], object]) -> Step:
    return lambda machine, _: machine.push(make(machine.since_mark()))


def _tuple_of(count: int) -> Step:
    return lambda machine, _: machine.push(tuple(machine.take(count)))


def _put(machine: Machine, index: int) -> None:
    machine.memo[index] = machine.stack[-1]


LITERALS = (
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
    *("BYTEARRAY8", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
)

STEPS: dict[str, Step] = {
    **dict.fromkeys(LITERALS, Machine.push),
    "NONE": _makes(lambda: None),
    "NEWTRUE": _makes(lambda: True),
    "NEWFALSE": _makes(lambda: False),
    "EMPTY_LIST": _makes(list),
    "EMPTY_DICT": _makes(dict),
    "EMPTY_SET": _makes(set),
    "EMPTY_TUPLE": _makes(tuple),
    "LIST": _collects(list),
    "TUPLE": _collects(tuple),
    "DICT": _collects(_pairs),
    "FROZENSET": _collects(lambda items: frozenset(map(check_key, items))),
    **{f"TUPLE{count}": _tuple_of(count) for count in (1, 2, 3)},
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda m, i: m.push(m.memo[i])),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), _put),
    # These matter to Python's own unpickler only.
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda *_: None),
    "MEMOIZE": lambda m, _: _put(m, len(m.memo)),
    "MARK": Machine.mark,
    "POP": _pop,
    "POP_MARK": lambda m, _: m.since_mark(),
    "DUP": lambda m, _: m.push(m.stack[-1]),
    "APPEND": lambda m, _: m.extend(m.take(1)),
    "APPENDS": lambda m, _: m.extend(m.since_mark()),
    "SETITEM": lambda m, _: m.update(m.take(2)),
    "SETITEMS": lambda m, _: m.update(m.since_mark()),
    "ADDITEMS": Machine.add,
    "GLOBAL": lambda m, a: m.name(*a.split(" ", 1)),
    "STACK_GLOBAL": lambda m, _: m.name(*m.take(2)),
    "REDUCE": lambda m, _: m.call(*m.take(2)),
    "NEWOBJ": lambda m, _: m.call(*m.take(2)),
    "NEWOBJ_EX": _new_object_ex,
    "INST": _instance,
    "OBJ": _object,
    "BUILD": Machine.build,
    "PERSID": lambda m, a: m.push(m.persistent(a)),
    "BINPERSID": lambda m, _: m.push(m.persistent(m.stack.pop())),
}
"""Opcode -> what it does. EXT* (Python's registry of classes) and *_BUFFER are not known."""
