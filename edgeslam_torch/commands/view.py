"""Open a run's report in the browser, or its recording in the rerun viewer."""

import argparse
import webbrowser
from pathlib import Path

from edgeslam_torch.files.output_file import output_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("run", type=Path, metavar="DIR", help="output folder of 'edgeslam run'")
    parser.add_argument(
        "--viewer", action="store_true", help="the rerun viewer instead of the browser ([viewer] extra)"
    )
    parser.add_argument(
        "--save-rrd", type=output_file, metavar="FILE", help="write a rerun recording instead of showing it"
    )
    parser.add_argument("--print", action="store_true", dest="only_print", help="only print the path of the page")


def main(args: argparse.Namespace) -> int:
    """Open the page, writing it first if missing; without a browser, print its path."""
    if args.viewer or args.save_rrd is not None:
        return _rerun(args)
    page = args.run / "report.html"
    if not page.is_file():
        from edgeslam_torch.eval.report.page import write_report
        from edgeslam_torch.terminal.progress import Progress

        with Progress("making the report"):
            page = write_report(args.run)
    print(page.resolve())
    if not args.only_print and not webbrowser.open(page.resolve().as_uri()):
        print("no browser here: copy the page to a machine with one; it is self-contained")
    return 0


def _rerun(args: argparse.Namespace) -> int:
    from edgeslam_torch.eval.inputs.run_folder import open_run
    from edgeslam_torch.geometry.camera_file import load_camera
    from edgeslam_torch.viewer.rerun_viewer import Viewer

    run = open_run(args.run)
    viewer = Viewer(run.name, save=args.save_rrd, show=args.save_rrd is None, live=False)
    if (run.path / "camera.yaml").is_file():
        viewer.camera(load_camera(run.path / "camera.yaml"))
    viewer.show_run(run.trajectory.stamps_s, run.trajectory.T_w_c, run.cloud(), run.cloud("anchors.ply"))
    viewer.close()
    if args.save_rrd is not None:
        print(args.save_rrd)
    return 0
