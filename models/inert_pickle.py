"""Pickles that torch writes, interpreted without importing or calling anything.

A pickle is a program: it calls whatever it names. Here a name stays a `Name` and a call a `Call`: the result is a tree
of plain values for the caller to inspect. Python's interpreter of pickles runs it, without the instructions that torch
does not write, and with its own for all that looks up, calls, hashes or copies. So every instruction costs time and
memory in proportion to its own bytes, and no input takes longer than a second.
"""

import io
import pickle
import struct
from collections.abc import Callable
from dataclasses import dataclass
from mmap import mmap
from typing import Any, NamedTuple

from edgeslam_torch.errors import WeightsError

MAX_BYTES = 1 << 21
"""Maximum size of a pickle; a FastDepth module's has 50 kB."""


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


_Interpreter: Any = pickle._Unpickler
_OPCODES = _Interpreter.dispatch


class InertPickle(_Interpreter):
    """Interprets consecutive pickles in a block of bytes.

    Args:
        data: The block, of which the first `MAX_BYTES` are read.
    """

    def __init__(self, data: bytes | mmap) -> None:
        self._block = io.BytesIO(data[:MAX_BYTES])
        super().__init__(self._block, encoding="utf-8", errors="surrogatepass")
        self.externals: list[External] = []
        """External references of all pickles so far."""

    @property
    def position(self) -> int:
        """Where the next pickle begins."""
        return self._block.tell()

    def load(self) -> Any:
        """The value of the next pickle.

        Raises:
            WeightsError: If it is damaged, too long, or uses an instruction that torch does not write.
        """
        self.memo: dict[int, Any] = {}
        try:
            return super().load()
        except EOFError:
            raise WeightsError(f"truncated checkpoint, or its pickle is larger than {MAX_BYTES >> 20} MiB") from None
        except (LookupError, TypeError, ValueError, AttributeError, struct.error, pickle.UnpicklingError):
            raise WeightsError("damaged checkpoint: its pickle is malformed, or not of torch") from None

    def find_class(self, module: str, name: str) -> Name:
        """The name itself."""
        return Name(module, name)

    def persistent_load(self, pid: Any) -> Any:
        """A reference, or the class that old torch wraps as ``("module", class, file, source)``."""
        if isinstance(pid, tuple) and len(pid) == 4 and pid[0] == "module" and isinstance(pid[1], Name):
            return pid[1]
        self.externals.append(External(pid))
        return self.externals[-1]

    def _set(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if isinstance(target, Call | Instance):  # an instance of a dict subclass
            return
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int):  # hashing a nested tuple may take unbounded time
                raise TypeError
            target[key] = value

    def _set_item(self) -> None:
        value = self.stack.pop()
        self._set([self.stack.pop(), value])

    def _extend(self) -> None:
        items = self.pop_mark()
        if not isinstance(self.stack[-1], list):
            raise TypeError
        self.stack[-1].extend(items)

    def _call(self) -> None:
        arguments, name = self.stack.pop(), self.stack.pop()
        if not (isinstance(name, Name) and isinstance(arguments, tuple)):
            raise TypeError
        empty_dict = name == Name("collections", "OrderedDict") and not arguments
        self.append({} if empty_dict else Call(name, arguments))

    def _new(self) -> None:
        self.stack.pop()
        name = self.stack.pop()
        if not isinstance(name, Name):
            raise TypeError
        self.append(Instance(name))

    def _new_with_keywords(self) -> None:
        self.stack.pop()
        self._new()

    def _build(self) -> None:
        state = self.stack.pop()
        if isinstance(self.stack[-1], Instance):
            self.stack[-1].state = state

    dispatch: dict[int, Callable[[Any], object]] = {code[0]: _OPCODES[code[0]] for code in (
        pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.POP, pickle.POP_MARK, pickle.DUP,
        pickle.NONE, pickle.NEWTRUE, pickle.NEWFALSE, pickle.BINFLOAT,
        pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.LONG4,
        pickle.SHORT_BINSTRING, pickle.BINSTRING, pickle.SHORT_BINUNICODE, pickle.BINUNICODE, pickle.BINUNICODE8,
        pickle.SHORT_BINBYTES, pickle.BINBYTES, pickle.BINBYTES8,
        pickle.EMPTY_TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3, pickle.TUPLE, pickle.EMPTY_LIST,
        pickle.APPEND, pickle.EMPTY_DICT, pickle.BINPUT, pickle.LONG_BINPUT, pickle.MEMOIZE,
        pickle.BINGET, pickle.LONG_BINGET, pickle.GLOBAL, pickle.STACK_GLOBAL, pickle.BINPERSID,
    )}  # fmt: skip
    """Protocols 2 to 5 as torch.save writes them; it never wrote protocols 0 and 1."""
    dispatch |= {
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: lambda self: self._set(self.pop_mark()),
        pickle.APPENDS[0]: _extend,
        pickle.EMPTY_SET[0]: lambda self: self.append([]),  # not needed, and what is in it would be hashed
        pickle.ADDITEMS[0]: _extend,
        pickle.FROZENSET[0]: lambda self: self.append(tuple(self.pop_mark())),
        pickle.REDUCE[0]: _call,
        pickle.NEWOBJ[0]: _new,
        pickle.NEWOBJ_EX[0]: _new_with_keywords,
        pickle.BUILD[0]: _build,
    }
