"""`lpv-track trajectories`: published against achieved rows of paths, drawn and written."""

import argparse
from pathlib import Path

from rich.console import Console

EXAMPLE = "lpv-track trajectories --draw trajectories.png --write paths"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="default: the six and their raw forms"
    )
    parser.add_argument("--draw", type=Path, metavar="FILE", help="picture, .png or .svg")
    parser.add_argument("--write", type=Path, metavar="DIR", help="write native CSV files")


def run(options: argparse.Namespace, console: Console) -> int:
    """Print the table of the paths, draw and write them as asked, and return 0."""
    import trajectories
    from experiments.run.suites import RAW, SIX
    from experiments.trajectory_figures import draw, rows_table

    names = options.names or [*SIX, *RAW]
    paths = [trajectories.load(name) for name in names]
    console.print(rows_table(paths))
    if options.draw is not None:
        draw(paths if options.names else paths[: len(SIX)], options.draw)
        console.print(f"drawn: {options.draw}", markup=False, soft_wrap=True)
    if options.write is not None:
        from trajectories.files import write

        options.write.mkdir(parents=True, exist_ok=True)
        for path in paths:
            write(path, options.write / f"{path.name}.csv")
        console.print(
            f"{len(paths)} paths written to {options.write}", markup=False, soft_wrap=True
        )
    return 0
