"""Conditions of a measurement: the machine, how fast it is at the moment, and the state of the code."""

import hashlib
import os
import platform
import statistics
import subprocess
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgeslam_torch import __version__

_CODE = tuple(f":(top){folder}" for folder in ("edgeslam_torch", "models", "losses", "train", "eval"))
"""What figures depend on: documents and tests may change without making them old."""

_PASSES = 15


def machine() -> dict[str, Any]:
    """Conditions that times depend on."""
    model = ""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return {
        "cpu": model or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def stamp(commit: str | None = None) -> dict[str, Any]:
    """Of which code and when a record is; ``commit`` is read from git when None."""
    made = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return {"version": __version__, "commit": commit or code_state(), "made": made}


def orb_pass_ms() -> float:
    """CPU time of one pass of ORB (1000 features) over one 640 x 480 image: the unit that costs are stated in.

    Every system of this kind spends some such passes on a frame, and they take as much longer on a slower processor.
    Timed right before and after a run, it is also as slow as the machine was then.
    """
    cv2.setNumThreads(1)
    noise = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
    image = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    orb = cv2.ORB.create(1000)
    times = []
    for _ in range(_PASSES):
        start = time.thread_time()
        orb.detectAndCompute(image, None)
        times.append(1e3 * (time.thread_time() - start))
    return statistics.median(times)


def code_state() -> str:
    """Commit that last changed the code, with a digest of what was changed since; the version outside a checkout."""
    head = _git("log", "-1", "--format=%h", "--", *_CODE)
    if not head:
        return f"version {__version__}"
    changes = _git("diff", "HEAD", "--", *_CODE) + _git("status", "--porcelain", "--", *_CODE)
    return f"{head}+{hashlib.sha256(changes.encode()).hexdigest()[:8]}" if changes else head


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(Path(__file__).resolve().parent), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
