"""What a run's summary says, changed."""

import json


def with_summary(folder, **changes):
    """The run's folder, with other values in its ``summary.json``."""
    file = folder / "summary.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    return folder
