"""The part of the pickle language that torch writes, interpreted without importing or calling anything.

A pickle is a program: ``GLOBAL`` and ``REDUCE`` call whatever it names. Here a name stays a `Name` and a call a `Call`:
the result is a tree of plain values for the caller to inspect. Every instruction costs time and memory in proportion
to its own bytes, and their number is bounded, so that no input takes longer than a second.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from mmap import mmap
from typing import Any, NamedTuple

from edgeslam_torch.errors import WeightsError

MAX_STEPS = 300_000
"""Maximum number of instructions; a FastDepth module has 24 000."""
_MARK = object()


class Name(NamedTuple):
    """A class or function that a pickle refers to, never looked up."""

    module: str
    name: str


class Call(NamedTuple):
    """A call that a pickle would have made."""

    name: Name
    arguments: tuple[Any, ...]


class External(NamedTuple):
    """A reference to data outside the pickle, such as a tensor's bytes."""

    id: Any


@dataclass(slots=True, eq=False)
class Instance:
    """An object made without a call, with the state it would have been given."""

    name: Name
    state: Any = None


class InertPickle:
    """Interprets consecutive pickles in a block of bytes.

    Args:
        data: The block.
        start: Where the first pickle begins.
        allowed: Predicate for the names that a pickle may refer to.
    """

    def __init__(self, data: bytes | mmap, allowed: Callable[[Name], bool], start: int = 0) -> None:
        self._data = data
        self._allowed = allowed
        self.position = start
        """Where the next pickle begins."""
        self.externals: list[External] = []
        """External references of all pickles so far."""
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def load(self) -> Any:
        """The value of the next pickle.

        Raises:
            WeightsError: If it is damaged, too long, refers to a name that is not allowed, or uses an instruction that
                torch does not write.
        """
        self._stack, self._memo = [], {}
        try:
            for _ in range(MAX_STEPS):
                code = self._take(1)
                if code == b".":
                    return self._stack.pop()
                instruction = _INSTRUCTIONS.get(code)
                if instruction is None:
                    raise WeightsError(f"no checkpoint of torch: pickle instruction 0x{code.hex()}")
                instruction(self)
        except (IndexError, KeyError, TypeError, ValueError, AttributeError):
            raise WeightsError("damaged checkpoint: its pickle is malformed") from None
        raise WeightsError(f"no checkpoint of ours: its pickle has more than {MAX_STEPS} instructions")

    def _take(self, count: int) -> bytes:
        end = self.position + count
        if end > len(self._data):
            raise WeightsError("truncated checkpoint: its pickle ends early")
        taken = self._data[self.position : end]
        self.position = end
        return taken

    def _number(self, format: str) -> Any:
        return struct.unpack(format, self._take(struct.calcsize(format)))[0]

    def _line(self) -> str:
        end = self._data.find(b"\n", self.position, self.position + 200)
        if end < 0:
            raise WeightsError("damaged checkpoint: its pickle is malformed")
        line = self._take(end - self.position)
        self.position += 1
        return line.decode()

    def _push(self, value: Any) -> None:
        self._stack.append(value)

    def _push_text(self, length: int) -> None:
        self._stack.append(self._take(length).decode("utf-8", "surrogatepass"))

    def _push_integer(self, length: int) -> None:
        self._stack.append(int.from_bytes(self._take(length), "little", signed=True))

    def _pop_to_mark(self) -> list[Any]:
        start = len(self._stack) - 1
        while self._stack[start] is not _MARK:  # an IndexError when there is none
            start -= 1
        items = self._stack[start + 1 :]
        del self._stack[start:]
        return items

    def _push_tuple(self, count: int) -> None:
        start = len(self._stack) - count
        if start < 0:
            raise IndexError
        items = tuple(self._stack[start:])
        del self._stack[start:]
        self._stack.append(items)

    def _extend(self, items: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, list):
            raise TypeError
        target.extend(items)

    def _set(self, items: list[Any]) -> None:
        target = self._stack[-1]
        if isinstance(target, Call | Instance):  # an instance of a dict subclass
            return
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int):  # hashing a nested tuple may take unbounded time
                raise TypeError
            target[key] = value

    def _pop_pair(self) -> list[Any]:
        value = self._stack.pop()
        return [self._stack.pop(), value]

    def _name(self, module: str, name: str) -> None:
        found = Name(module, name)
        if not self._allowed(found):
            raise WeightsError(
                f"checkpoint refers to {module[:80]}.{name[:80]}: refused, it may run code; nothing was run"
            )
        self._stack.append(found)

    def _stack_name(self) -> None:
        module, name = self._pop_pair()
        if not (isinstance(module, str) and isinstance(name, str)):
            raise TypeError
        self._name(module, name)

    def _call(self) -> None:
        name, arguments = self._pop_pair()
        if not (isinstance(name, Name) and isinstance(arguments, tuple)):
            raise TypeError
        empty_dict = name == Name("collections", "OrderedDict") and not arguments
        self._stack.append({} if empty_dict else Call(name, arguments))

    def _new(self, with_keywords: bool) -> None:
        if with_keywords:
            self._stack.pop()
        name, _ = self._pop_pair()
        if not isinstance(name, Name):
            raise TypeError
        self._stack.append(Instance(name))

    def _build(self) -> None:
        state = self._stack.pop()
        if isinstance(self._stack[-1], Instance):
            self._stack[-1].state = state

    def _external(self) -> None:
        id = self._stack.pop()
        if isinstance(id, tuple) and len(id) == 4 and id[0] == "module" and isinstance(id[1], Name):
            self._stack.append(id[1])  # old torch wraps a class as ("module", class, file, source)
            return
        self.externals.append(External(id))
        self._stack.append(self.externals[-1])

    def _put(self, index: int) -> None:
        self._memo[index] = self._stack[-1]


def _constant(value: Any) -> Callable[[InertPickle], None]:
    return lambda machine: machine._push(value)


_INSTRUCTIONS: dict[bytes, Callable[[InertPickle], object]] = {
    b"\x80": lambda m: m._take(1),  # PROTO
    b"\x95": lambda m: m._take(8),  # FRAME
    b"(": _constant(_MARK),
    b"0": lambda m: m._stack.pop(),
    b"1": lambda m: m._pop_to_mark(),
    b"2": lambda m: m._push(m._stack[-1]),
    b"N": _constant(None),
    b"\x88": _constant(True),
    b"\x89": _constant(False),
    b")": _constant(()),
    b"K": lambda m: m._push(m._number("<B")),
    b"M": lambda m: m._push(m._number("<H")),
    b"J": lambda m: m._push(m._number("<i")),
    b"G": lambda m: m._push(m._number(">d")),
    b"\x8a": lambda m: m._push_integer(m._number("<B")),
    b"\x8b": lambda m: m._push_integer(m._number("<I")),
    b"U": lambda m: m._push_text(m._number("<B")),
    b"T": lambda m: m._push_text(m._number("<I")),
    b"X": lambda m: m._push_text(m._number("<I")),
    b"\x8c": lambda m: m._push_text(m._number("<B")),
    b"\x8d": lambda m: m._push_text(m._number("<Q")),
    b"C": lambda m: m._push(m._take(m._number("<B"))),
    b"B": lambda m: m._push(m._take(m._number("<I"))),
    b"\x8e": lambda m: m._push(m._take(m._number("<Q"))),
    b"\x85": lambda m: m._push_tuple(1),
    b"\x86": lambda m: m._push_tuple(2),
    b"\x87": lambda m: m._push_tuple(3),
    b"t": lambda m: m._push(tuple(m._pop_to_mark())),
    b"]": lambda m: m._push([]),
    b"a": lambda m: m._extend([m._stack.pop()]),
    b"e": lambda m: m._extend(m._pop_to_mark()),
    b"\x8f": lambda m: m._push([]),  # a set; not needed
    b"\x90": lambda m: m._extend(m._pop_to_mark()),
    b"\x91": lambda m: m._push(tuple(m._pop_to_mark())),
    b"}": lambda m: m._push({}),
    b"s": lambda m: m._set(m._pop_pair()),
    b"u": lambda m: m._set(m._pop_to_mark()),
    b"q": lambda m: m._put(m._number("<B")),
    b"r": lambda m: m._put(m._number("<I")),
    b"\x94": lambda m: m._put(len(m._memo)),
    b"h": lambda m: m._push(m._memo[m._number("<B")]),
    b"j": lambda m: m._push(m._memo[m._number("<I")]),
    b"c": lambda m: m._name(m._line(), m._line()),
    b"\x93": lambda m: m._stack_name(),
    b"R": lambda m: m._call(),
    b"\x81": lambda m: m._new(with_keywords=False),
    b"\x92": lambda m: m._new(with_keywords=True),
    b"b": lambda m: m._build(),
    b"Q": lambda m: m._external(),
}
"""Protocols 2 to 5 as torch.save writes them; it never wrote protocols 0 and 1."""
