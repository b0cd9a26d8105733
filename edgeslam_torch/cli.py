"""``edgeslam``: the command line.

Nothing is imported before `main` handles Ctrl-C, and nothing heavy before a command needs it.
"""

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType

COMMANDS = {
    "demo": ("edgeslam_torch.commands.demo", "fly a simulated drone through a simulated house; needs no data"),
    "run": ("edgeslam_torch.commands.run", "trajectory and edge map from a recording, a video or a live camera"),
    "topics": ("edgeslam_torch.commands.topics", "what a ROS bag holds, and what a run would use of it"),
    "eval": ("edgeslam_torch.commands.judging.eval", "judge runs or trajectory files against ground truth"),
    "compare": ("edgeslam_torch.commands.judging.compare", "two runs side by side, against one ground truth"),
    "bench": ("edgeslam_torch.commands.judging.bench", "accuracy and speed in one table, beside other systems"),
    "judge": (
        "edgeslam_torch.commands.judging.judge",
        "every recording, variant and simulated flight in one table with limits",
    ),
    "ablation": (
        "edgeslam_torch.commands.judging.ablation",
        "contribution of each loss: one table, one change at a time",
    ),
    "batch": ("edgeslam_torch.commands.batch", "run, evaluate and report many recordings, on all cores or a cluster"),
    "data": ("edgeslam_torch.commands.data", "fetch published recordings from their authors, ready to run"),
    "report": ("edgeslam_torch.commands.report", "make the report page of a run"),
    "view": ("edgeslam_torch.commands.view", "open a run's report or viewer"),
    "depth": ("edgeslam_torch.commands.depth", "depth maps of images, folders or videos"),
    "finetune": ("edgeslam_torch.commands.training.finetune", "train the depth network on your own recordings"),
    "distil": ("edgeslam_torch.commands.training.distil", "train the depth network on the predictions of a larger one"),
    "export": ("edgeslam_torch.commands.export", "depth network to ONNX for the companion computer"),
    "weights": ("edgeslam_torch.commands.weights", "list, download, convert and inspect network weights"),
    "record": ("edgeslam_torch.commands.record", "record a flight or a camera"),
    "calibrate": ("edgeslam_torch.commands.calibrate", "camera calibration from chessboard pictures"),
    "fly": ("edgeslam_torch.commands.flying.fly", "fly a Tello by its own map: to a point, exploring, home"),
    "sim": ("edgeslam_torch.commands.sim", "a simulated Tello on this machine's loopback"),
    "export-map": (
        "edgeslam_torch.commands.export_map",
        "map to PLY, PCD, LAS, COLMAP, nerfstudio or occupancy",
    ),
}
"""Name: (module, one line of help). A command whose module is missing is not offered."""

EXIT_INTERRUPTED = 130
_SWALLOWING = ("<frozen importlib._bootstrap>", "/llvmlite/binding/executionengine.py")
"""Ends of the names of files in whose functions exceptions are changed, or dropped by native code that calls them."""
_AGAIN_S = 0.005
"""Short against the time between a command's last import and its first file."""


def available() -> dict[str, tuple[str, str]]:
    """Commands of this installation."""
    from importlib.util import find_spec

    return {name: entry for name, entry in COMMANDS.items() if find_spec(entry[0]) is not None}


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code.

    Args:
        argv: Arguments after ``edgeslam``; those of the process when None.
    """
    ctrl_c = _CtrlC()
    try:
        if argv is None:
            ctrl_c.take()
        from edgeslam_torch.command_line import run_command

        return run_command(sys.argv[1:] if argv is None else argv, available())
    except BaseException as error:
        # Libraries convert a Ctrl-C into many exceptions.
        if not isinstance(error, KeyboardInterrupt) and (isinstance(error, SystemExit) or not ctrl_c.raised):
            raise
        sys.stderr.write("edgeslam: interrupted\n")
        return EXIT_INTERRUPTED
    finally:
        ctrl_c.give_back()


class _CtrlC:
    """Ctrl-C, delayed while modules load: numpy converts it to another error, weak-reference callbacks swallow it,
    and optional imports would treat it as a missing module. Also while loops compile: LLVM swallows it."""

    def __init__(self) -> None:
        self.raised = False
        self._taken = False
        self._postponed = False

    def take(self) -> None:
        """Install the handler unless there is another one or Ctrl-C is ignored."""
        import signal

        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._on_signal)
            self._taken = True

    def give_back(self) -> None:
        """Let Ctrl-C end the program silently: only interpreter shutdown is left."""
        if self._taken:
            import signal

            signal.signal(signal.SIGINT, signal.SIG_DFL)

    def _on_signal(self, number: int, frame: "FrameType | None") -> None:
        while frame is not None:
            if frame.f_code.co_filename.replace("\\", "/").endswith(_SWALLOWING):
                self._postpone()
                return
            frame = frame.f_back
        self.raised = True
        raise KeyboardInterrupt

    def _postpone(self) -> None:
        """Request the signal again, once for any number of signals: one thread each would exhaust them."""
        import threading

        if not self._postponed:
            self._postponed = True
            threading.Timer(_AGAIN_S, self._again).start()

    def _again(self) -> None:
        import _thread

        self._postponed = False
        _thread.interrupt_main()


if __name__ == "__main__":
    sys.exit(main())
