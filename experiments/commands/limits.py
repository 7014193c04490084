"""`lpv-track limits`: the physical limits of lane changes and laps, by optimal control."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from experiments.commands import options as shared
from experiments.commands.options import EXIT_FAILED, EXIT_INTERRUPTED, file_name

if TYPE_CHECKING:
    from experiments.run.physical_limits import Limit, LimitCase

EXAMPLE = "lpv-track limits iso-3888-2-1.61 --vehicle bmw-320i --friction 0.9 --draw limits"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    from experiments.run.physical_limits import CORRIDOR

    parser.add_argument(
        "paths", nargs="*", metavar="PATH",
        help="lane changes with cones, or closed paths for laps; default: those that are shipped",
    )  # fmt: skip
    parser.add_argument("--vehicle", default="bmw-320i", help="default: %(default)s")
    parser.add_argument(
        "--friction", type=shared.number(0.05, 2.0), default=0.9, help="default: %(default)s"
    )
    parser.add_argument(
        "--corridor", type=shared.number(0.01, 10.0, "m"), default=CORRIDOR, metavar="M",
        help="largest lateral error of a lap, m; default: %(default)s",
    )  # fmt: skip
    parser.add_argument(
        "--kept", type=shared.number(0.0, 1.0), default=0.0, metavar="SHARE",
        help="share of the entry speed that must be kept on a lane change; default: %(default)s",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=file_name, metavar="FILE",
        help="JSON table; cases that it holds already, of the same paths, are not computed again",
    )  # fmt: skip
    parser.add_argument("--draw", type=file_name, metavar="DIR", help="a picture of each motion")


def run(options: argparse.Namespace, console: Console) -> int:
    """Compute limits, write and draw them as asked, print the table; return the exit code.

    0: each limit has passed its checks; 1: one has not; 130: Ctrl-C, the table holds what was done.
    """
    from experiments.run.physical_limits import CASES, LimitCase, read

    cases: Sequence[LimitCase] = CASES
    if options.paths:
        cases = [
            LimitCase(path, options.vehicle, options.friction, options.corridor, options.kept)
            for path in options.paths
        ]
    done = read(options.out) if options.out is not None and options.out.is_file() else []
    try:
        interrupted = _compute_all(cases, done, options.out, options.draw, console)
    finally:
        wanted = [limit for limit in done if limit.case in cases]
        if wanted:
            console.print(table(wanted))
    if interrupted:
        return EXIT_INTERRUPTED
    return 0 if all(limit.shown for limit in wanted) else EXIT_FAILED


def _compute_all(
    cases: "Sequence[LimitCase]", done: "list[Limit]", out: Path | None, folder: Path | None,
    console: Console,
) -> bool:  # fmt: skip
    """Add the limits of cases that are not `done`, and write them; return whether Ctrl-C came."""
    import trajectories
    from experiments.limits.compute import compute
    from experiments.limits.figures import draw
    from experiments.run.benchmark import progress_bar
    from experiments.run.engines import Interrupts
    from experiments.run.physical_limits import digest, write
    from trajectories.fileio import file_name as safe

    try:
        with progress_bar(console) as progress, Interrupts() as interrupts:
            bar = progress.add_task("", total=len(cases))
            for case in cases:
                label = f"{case.path}, {case.vehicle}, friction {case.friction:g}"

                def note(text: str, label: str = label) -> None:
                    interrupts.check()
                    progress.update(bar, description=f"{label}: {text}")

                now = digest(trajectories.load(case.path))
                kept = [one for one in done if (one.case, one.path_digest) == (case, now)]
                if not kept or folder is not None:
                    try:
                        found = compute(case, note)
                    except RuntimeError as error:
                        interrupts.check()  # CasADi takes Ctrl-C for a failed solve
                        raise ValueError(error) from None
                    interrupts.check()
                    done[:] = [one for one in done if one.case != case] + [found.limit]
                    if folder is not None:
                        folder.mkdir(parents=True, exist_ok=True)
                        name = safe(f"{case.path}-{case.vehicle}-{case.kept:g}")
                        draw(found, folder / f"{name}.png")
                    if out is not None:
                        write(done, out)
                progress.advance(bar)
    except KeyboardInterrupt:
        return True
    return False


def table(limits: "Sequence[Limit]") -> Table:
    """Return the console's table of limits."""
    from experiments.run.physical_limits import BEYOND

    shown = Table(
        title="Physical limits", title_justify="left", caption_justify="left",
        caption=(
            "kept: least share of the entry speed later on. replay: distance from the cones, or "
            "largest lateral error, of the inputs driven anew. "
            f"{100 * BEYOND:g} % better: the largest distance from the cones, or the narrowest "
            "corridor, that was found from all starts at so much more speed or less time."
        ),
    )  # fmt: skip
    shown.add_column("path", no_wrap=True)
    shown.add_column("vehicle", no_wrap=True)
    for heading in (
        "friction",
        "kept",
        "limit",
        "replay m",
        f"{100 * BEYOND:g} % better m",
        "solve s",
    ):
        shown.add_column(heading, justify="right", no_wrap=True)
    shown.add_column("shown")
    for one in limits:
        unit = "m/s" if one.kind == "entry speed" else "s"
        kept = f"{100 * one.case.kept:g} %" if one.kind == "entry speed" else ""
        shown.add_row(
            one.case.path, one.case.vehicle, f"{one.case.friction:g}", kept,
            f"{one.value:.3f} {unit}",
            f"{one.replayed:.4f}", f"{one.beyond:.4f}", f"{one.seconds:.0f}",
            "yes" if one.shown else "no",
        )  # fmt: skip
    return shown
