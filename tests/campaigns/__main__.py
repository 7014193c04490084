"""Run campaigns, print their counts, and end with 1 if anything broke."""

import argparse
import importlib
import sys
import time

from tests.campaigns import Counts

CAMPAIGNS = {
    # name: (count in full, what is counted)
    "hostile_solves": (1_000_000, "rows of absurd observations for every shipped agent"),
    "hostile_files": (20_000, "mutated files over every reader"),
    "hostile_commands": (300, "command lines with wrong values"),
    "hostile_arguments": (3_000, "arguments of wrong types and absurd values"),
    "kill_jobs": (100, "kill -9 of benchmark, train and tune at random moments"),
    "kill_ray": (20, "nodes of a Ray cluster and drivers killed at random moments"),
    "many_cases": (100_000, "cases in one folder: memory and time of resume, report, compare"),
    "soak": (10_000_000, "steps of vector environments with all settings"),
}


def main(arguments: list[str] | None = None) -> int:
    """Run the campaigns that the command line names; return 1 if anything broke."""
    lines = "\n".join(f"  {name:18} {n:>10,} {what}" for name, (n, what) in CAMPAIGNS.items())
    parser = argparse.ArgumentParser(
        "python -m tests.campaigns",
        description=f"Try to break the project. Campaigns and their counts in full:\n{lines}",
        epilog="example: python -m tests.campaigns hostile_files soak --share 0.01",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="campaigns; default: all")
    parser.add_argument("--share", type=float, default=1.0, help="share of the count in full")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in CAMPAIGNS]:
        parser.error(f"unknown campaign {unknown[0]!r}; known: {', '.join(CAMPAIGNS)}")
    if not 0.0 < options.share < 1000.0:
        parser.error("--share must be positive and below 1000")
    broken = 0
    for name in options.names or CAMPAIGNS:
        count = max(1, round(CAMPAIGNS[name][0] * options.share))
        module = importlib.import_module(f"tests.campaigns.{name}")
        began = time.perf_counter()
        counts: Counts = module.run(count, options.seed, lambda line: print("  ", line, flush=True))
        seen = ", ".join(f"{key} {value:,}" for key, value in counts.seen.items())
        print(
            f"{name}: {counts.tried:,} tried, {len(counts.faults)} broke, {seen}; "
            f"{time.perf_counter() - began:.0f} s",
            flush=True,
        )
        for fault in counts.faults[:20]:
            print("  broke:", fault[:300])
        broken += len(counts.faults)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
