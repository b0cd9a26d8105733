"""Maps of a flight as bytes, to start from copies of them."""

import io
import pickle
import threading


class _Pickler(pickle.Pickler):
    """Pickles a map: the copy gets a lock of its own."""

    def reducer_override(self, obj):
        if isinstance(obj, type(threading.RLock())):
            return threading.RLock, ()
        return NotImplemented


def pickled(state):
    """Records of a flight as bytes, maps and their locks included."""
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL).dump(state)
    return buffer.getvalue()
