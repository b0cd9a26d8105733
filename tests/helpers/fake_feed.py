"""Pictures of a live source that are there at once."""

import numpy as np

from edgeslam_torch.drone.video_stream import Picture


class FakeFeed:
    """Pictures that are there at once, numbered with gaps, as a slow taker sees them."""

    def __init__(self, counts):
        self.pictures = [Picture(0.1 * c, np.full((48, 64, 3), c, np.uint8), c) for c in counts]
        self.closed = 0

    def wait(self, after_count, timeout_s):
        return next((p for p in self.pictures if p.count > after_count), None)

    def remarks(self):
        return ["3 packets refused"]

    def close(self):
        self.closed += 1
