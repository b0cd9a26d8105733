"""``edgeslam fly``: fly a Tello by its own map; nothing moves without --fly."""

import argparse
import importlib
import math
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.commands.flying._signals import Signals, say
from edgeslam_torch.files.output_file import output_file

if TYPE_CHECKING:
    from edgeslam_torch.flying.navigator import Navigator
    from edgeslam_torch.flying.result import FlightResult
    from edgeslam_torch.navigation.limits import NavLimits
    from edgeslam_torch.terminal.progress import Progress

EXIT_NOT_REACHED = 3
"""The flight ended safely, but did not reach its goal."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    goto = verbs.add_parser("goto", help="fly to a point around obstacles")
    goto.add_argument("x", type=float, metavar="X", help="metres ahead of the take-off")
    goto.add_argument("y", type=float, metavar="Y", help="metres to its left")
    goto.add_argument("z", type=float, nargs="?", metavar="Z", help="flight height above the floor")
    explore = verbs.add_parser("explore", help="explore by frontiers")
    explore.add_argument("seconds", type=float, metavar="SECONDS", help="duration")
    corridor = verbs.add_parser("corridor", help="follow the current corridor around corners, through no known door")
    exit_ = verbs.add_parser("exit", help="explore until an exit is found, and fly through it")
    for verb, longest_s in ((corridor, 120.0), (exit_, 180.0)):
        said = f"maximum duration (default: {longest_s:.0f})"
        verb.add_argument("seconds", type=float, nargs="?", metavar="SECONDS", default=longest_s, help=said)
    home = verbs.add_parser("home", help="take off, look around, return above the take-off, land: a first test")
    for verb in (goto, explore, corridor, exit_, home):
        _add_common(verb)
    again = verbs.add_parser("replay", help="run the planner on a recorded flight and compare its decisions")
    again.add_argument("folder", type=Path, metavar="DIR", help="folder of --record")
    again.add_argument("--speed", type=float, metavar="M_S", help="cruising speed (default: the flight's)")
    again.add_argument("--height", type=float, metavar="M", help="flight height (default: the flight's)")


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--drone",
        default="tello://",
        metavar="ADDRESS",
        help="tello://HOST[:PORTS], or sim://WORLD[:SEED] for an emulated one without network; WORLD is a name or a "
        "scene file *.toml (default: tello://)",
    )
    parser.add_argument("--fly", action="store_true", help="fly; without it nothing moves and the plan is shown")
    parser.add_argument("--dry-run", action="store_true", help="show the plan without contacting the drone")
    parser.add_argument("--back", action="store_true", help="return to the take-off before landing")
    parser.add_argument("--record", type=Path, metavar="DIR", help="record frames, state and decisions")
    parser.add_argument("--viewer", action="store_true", help="show map, path and decisions in rerun ([viewer] extra)")
    parser.add_argument("--save-rrd", type=output_file, metavar="FILE", help="save that recording to a file instead")
    parser.add_argument("--camera", metavar="FILE|PRESET", help="calibration of the drone's camera")
    parser.add_argument("--speed", type=float, metavar="M_S", help="cruising speed (default: 0.5)")
    parser.add_argument("--height", type=float, metavar="M", help="flight height (default: 1.15)")
    parser.add_argument("--fence", type=float, metavar="M", help="maximum distance from the take-off (default: 30)")


def main(args: argparse.Namespace) -> int:
    """Check, show the plan, and fly it with --fly."""
    if args.verb == "replay":
        return _replay(args)
    from edgeslam_torch.errors import ConfigError

    if args.fly and args.dry_run:
        raise ConfigError("--fly and --dry-run contradict each other")
    limits = _limits(args)
    _check(args, limits)
    for line in _plan(args, limits):
        say(line)
    if args.dry_run:
        say("nothing was sent to the drone")
        return 0
    from edgeslam_torch.terminal.progress import Progress

    with Progress("loading") as progress, Signals() as signals:
        try:
            signals.tell(lambda: None, patient=True)  # an import that is interrupted raises anything
            for vehicle in ("udp_vehicle", "lockstep_vehicle"):
                importlib.import_module(f"edgeslam_torch.flying.{vehicle}")
            if signals.number:
                raise KeyboardInterrupt
            signals.tell(None, patient=False)
            code = _connect(args, limits, signals, progress)
        except KeyboardInterrupt:
            say(f"ended by {signals.name}")
            code = signals.exit_code
    if args.fly and args.record is not None and args.record.is_dir():
        say(f"recorded: {args.record} (edgeslam run {args.record} maps it again)")
    return code


def _connect(args: argparse.Namespace, limits: "NavLimits", signals: Signals, progress: "Progress") -> int:
    """Connect, and fly with --fly; in any case the drone lands and the record is closed."""
    from edgeslam_torch.flying.keys import keys
    from edgeslam_torch.flying.navigator import Navigator

    record = args.record if args.fly else None
    with ExitStack() as open_:
        listeners = []
        if args.fly and (args.viewer or args.save_rrd is not None):
            from edgeslam_torch.viewer.flight_view import FlightView

            listeners.append(FlightView(args.drone, args.save_rrd))
            open_.callback(listeners[0].close)
        progress.phase(f"waiting for {args.drone}")
        nav = open_.enter_context(Navigator.open(args.drone, args.fly, limits, args.camera, listeners, record))
        open_.callback(signals.tell, lambda: None, patient=True)  # nothing interrupts landing and closing
        charge = nav.vehicle.battery
        known = f"battery {100 * charge:.0f} %, " if charge == charge else ""
        camera = nav.vehicle.camera
        say(f"{args.drone}: {known}pictures {camera.width}x{camera.height}, calibration: {camera.source}")
        if not args.fly:
            say("nothing moved: add --fly to fly this")
            return 0

        def end() -> None:
            """On a signal: land and finish in order; interrupt before the take-off is complete."""
            if not nav.vehicle.flying and not nav.vehicle.over:
                raise KeyboardInterrupt
            nav.flight_controller.land(f"by {signals.name}")

        with keys(nav.flight_controller.hold, lambda: nav.flight_controller.land("by the keyboard")) as listens:
            if listens:
                say("space toggles hovering; l, q or Ctrl-C lands")
            signals.tell(end, patient=True)
            progress.phase("")
            progress.words = partial(_status_text, nav)
            reached = _fly(args, nav)
    return signals.exit_code or (0 if reached else EXIT_NOT_REACHED)


def _replay(args: argparse.Namespace) -> int:
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.flying.replay import replay, summary

    given = {"speed_m_s": args.speed, "height_m": args.height}
    try:
        found = replay(args.folder, **{name: value for name, value in given.items() if value is not None})
    except ValueError as error:
        raise ConfigError(str(error)) from error
    for line in summary(found):
        print(line)
    return 0


def _limits(args: argparse.Namespace) -> "NavLimits":
    from dataclasses import replace

    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.navigation.limits import NavLimits

    height = args.height
    if args.verb == "goto" and args.z is not None:
        if height is not None and height != args.z:
            raise ConfigError(f"the height is given twice: Z {args.z:g} and --height {height:g}")
        height = args.z
    default = NavLimits()
    if height is not None and not default.lowest_m <= height <= default.highest_m:
        raise ConfigError(f"the flight height must be {default.lowest_m:g} to {default.highest_m:g} m, got {height:g}")
    given = {"speed_m_s": args.speed, "height_m": height, "fence_m": args.fence}
    if args.speed is not None and not 0.05 <= args.speed <= 1.0:
        raise ConfigError(f"--speed must be 0.05 to 1 m/s, got {args.speed:g}")
    if args.fence is not None and args.fence <= 0:
        raise ConfigError(f"--fence must be positive, got {args.fence:g}")
    return replace(default, **{name: value for name, value in given.items() if value is not None})


def _check(args: argparse.Namespace, limits: "NavLimits") -> None:
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.flying.checks import check_goal

    if args.verb == "goto":
        check_goal((args.x, args.y, limits.height_m), limits)
    if args.verb in ("explore", "corridor", "exit") and not 0 < args.seconds < 3600:
        raise ConfigError(f"SECONDS must be above 0 and below 3600, got {args.seconds:g}")


def _plan(args: argparse.Namespace, limits: "NavLimits") -> list[str]:
    """The plan, one string per line."""
    what = "return above the take-off"
    if args.verb == "goto":
        away = math.hypot(args.x, args.y)
        what = (
            f"fly to ({args.x:g}, {args.y:g}): {away:.1f} m in a straight line, "
            f"at least {away / limits.speed_m_s:.0f} s, around mapped obstacles"
        )
    elif args.verb == "explore":
        what = f"explore for {args.seconds:g} s by frontiers"
    elif args.verb == "corridor":
        what = f"follow the corridor for at most {args.seconds:g} s, until it ends or opens into a room"
    elif args.verb == "exit":
        what = f"explore for at most {args.seconds:g} s until an exit is found, and fly through it"
    steps = [f"take off and rise to {limits.height_m:.2f} m", what]
    steps += ["return above the take-off"] if args.back and args.verb != "home" else []
    lines = [f"{n}. {step}" for n, step in enumerate([*steps, "land"], 1)]
    return [
        "plan:",
        *lines,
        f"limits: {limits.speed_m_s:g} m/s on average, heights {limits.lowest_m:g} to {limits.highest_m:g} m, "
        f"{limits.fence_m:g} m from the take-off, home at {100 * limits.home_battery:.0f} % battery; "
        "only through observed free space",
    ]


def _fly(args: argparse.Namespace, nav: "Navigator") -> bool:
    outcome = _reported("take-off", nav.take_off())
    if nav.vehicle.flying and outcome.reached:
        outcome = _verb(args, nav)
    if nav.vehicle.flying and args.back and args.verb != "home":
        _reported("return", nav.return_home())
    if nav.vehicle.flying:
        _reported("landing", nav.land())
    return outcome.reached


def _status_text(nav: "Navigator") -> str:
    """Status line: phase, reason, battery, height, pose and path length."""
    import numpy as np

    from edgeslam_torch.terminal.run_progress import position_text

    controller = nav.flight_controller
    charge, state, order = nav.vehicle.battery, controller.state, controller.last
    phase, parts = "taking off", [f"battery {100 * charge:.0f} %"] if charge == charge else []
    if state is None:
        phase = "taking off, waiting for the drone to hover"
    elif order is not None:
        phase = "landing" if order.land or not nav.vehicle.flying else str(controller.pilot.phase)
        track = controller.track()
        height = f"height {state.reported_height_m:.2f} m" if math.isfinite(state.reported_height_m) else ""
        unit = "m" if state.metric else "units, no metric scale yet"
        flown = float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum())
        place = f"{position_text(state.p_w)} +- {state.home_sigma_m:.2g} {unit}"
        lost = "" if state.tracked else "dead reckoning"
        parts = [
            "" if order.command.why == phase else order.command.why,
            *parts,
            height,
            place,
            lost,
            f"{flown:.1f} m flown",
        ]
    return ", ".join(part for part in (phase, *parts) if part)


def _verb(args: argparse.Namespace, nav: "Navigator") -> "FlightResult":
    if args.verb == "goto":
        return _reported("goto", nav.go_to((args.x, args.y, nav.limits.height_m)))
    if args.verb == "explore":
        outcome = _reported("explore", nav.explore(args.seconds))
        _tell_openings(nav)
        return outcome
    if args.verb == "corridor":
        outcome = _reported("corridor", nav.follow_corridor(args.seconds))
        _tell_openings(nav)
        return outcome
    if args.verb == "exit":
        outcome = _reported("search", nav.find_exits(args.seconds))
        _tell_openings(nav)
        return _reported("exit", nav.go_through(nav.exits()[0])) if nav.vehicle.flying and nav.exits() else outcome
    return _reported("home", nav.return_home())


def _tell_openings(nav: "Navigator") -> None:
    """Print exits and pathways, a line each."""
    for exit_ in nav.exits():
        x, y = exit_.centre_w[:2]
        say(
            f"  exit at ({x:.2f}, {y:.2f}) +- {exit_.position_sigma_m:.2f} m, {exit_.width_m:.2f} +- "
            f"{exit_.width_sigma_m:.2f} m wide, seen from {exit_.places} viewpoints"
        )
    for way in nav.pathways() if nav.vehicle.flying else ():
        (x0, y0), (x1, y1) = way.ends_w
        say(
            f"  corridor from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}), {way.width_m:.1f} +- "
            f"{way.width_sigma_m:.1f} m wide"
        )


def _reported(what: str, outcome: "FlightResult") -> "FlightResult":
    clear = outcome.min_clearance_m
    known = f", nearest mapped obstacle {clear:.2f} m from the hull" if clear == clear else ""
    say(f"{what}: {outcome.reason}; {outcome.path_m:.1f} m flown{known}")
    return outcome
