"""Maps of a flight as bytes, to start from copies of them."""

import io
import pickle
import threading
from typing import Any


class _Pickler(pickle.Pickler):
    """Pickles a map: the copy gets a lock of its own."""

    def reducer_override(self, obj: object) -> Any:
        if isinstance(obj, type(threading.RLock())):
            return threading.RLock, ()
        return NotImplemented


def pickled(state: object) -> bytes:
    """Records of a flight as bytes, maps and their locks included."""
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL).dump(state)
    return buffer.getvalue()
