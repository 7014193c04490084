"""Compare two folders of results, value by value to the last digit."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from experiments.run.exact import compare, report_lines

EXAMPLE = "python -m experiments.run.compare results/before results/after"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the differences; return 0 if there are none, 1 if there are, 2 without results."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.run.compare", description=__doc__,
        epilog=f"example: {EXAMPLE}", formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("first", type=Path, metavar="A", help="folder of results")
    parser.add_argument("second", type=Path, metavar="B", help="folder to compare with it")
    options = parser.parse_args(arguments)
    try:
        found = compare(options.first, options.second)
    except (ValueError, OSError) as error:
        print(f"compare: {error}")
        return 2
    print("\n".join(report_lines(found)))
    return 1 if found.differences else 0


if __name__ == "__main__":
    raise SystemExit(main())
