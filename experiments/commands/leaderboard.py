"""`lpv-track leaderboard`: results folders ranked on one page, a sample of each row run again."""

import argparse
import shlex

from rich.console import Console

from experiments.commands import options as shared

EXAMPLE = "lpv-track leaderboard results/benchmark results/limits --out build/leaderboard"
SAMPLE = 5
MOST_LINES = 10
"""Most lines that are printed on what cannot be read."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "folders", nargs="+", type=shared.file_name, metavar="FOLDER", help="folder of results"
    )
    shared.add_out(parser, "build/leaderboard")
    parser.add_argument(
        "--sample", type=shared.whole(0, 100_000), default=SAMPLE, metavar="N",
        help=f"cases of each row that are run again (default {SAMPLE}; 0: none)",
    )  # fmt: skip
    shared.add_seed(parser)
    parser.add_argument("--title", default="Leaderboard", help="default: Leaderboard")
    parser.add_argument(
        "--open-named-files", action="store_true",
        help="run the agents and open the files that the results name; for results you trust",
    )  # fmt: skip
    shared.add_engine(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Write `index.html` and `leaderboard.md`; return 1 if a row does not reproduce, else 0."""
    from experiments.leaderboard import board, marks
    from experiments.leaderboard.rows import sections_of
    from trajectories.fileio import write_atomically

    engine = shared.engine_of(options)
    skipped: list[str] = []
    sections = sections_of(options.folders, skipped)
    rows = [row for section in sections for row in section.rows]
    if not rows:
        raise ValueError(skipped[1] if len(skipped) > 1 else skipped[0])
    for line in skipped[:MOST_LINES]:
        console.out(f"left out: {line}", style="red", highlight=False)
    if len(skipped) > MOST_LINES:
        console.print(f"left out: {len(skipped) - MOST_LINES} more lines", style="red")
    options.out.mkdir(parents=True, exist_ok=True)
    found = {row.key: mark for row in rows if (mark := marks.altered(row))}
    sound = [row for row in rows if row.key not in found]
    samples = {row.key: marks.sample(row, options.sample, options.seed) for row in rows}
    try:
        found |= marks.marks_of(
            sound, samples, engine=engine, open_named_files=options.open_named_files,
            console=console,
        )  # fmt: skip
    except KeyboardInterrupt:
        console.print("interrupted: nothing is written; --sample 0 runs no case again")
        raise
    ids = {key: [str(case["id"]) for case in cases] for key, cases in samples.items()}
    made = [(section, board.entries_of(section, found, ids)) for section in sections]
    command = _command(options)
    page = board.page(made, options.title, f"made by {command}", skipped)
    write_atomically(options.out / "index.html", page.encode(errors="backslashreplace"))
    text = board.markdown(made, options.title, command, skipped)
    write_atomically(options.out / "leaderboard.md", text.encode(errors="backslashreplace"))
    refuted = [row for row in rows if found[row.key].refuted]
    for row in refuted:
        mark = found[row.key]
        line = f"{row.label} in {row.store.folder}: {mark.words}: {mark.remark}"
        console.print(line, markup=False, style="red")
    console.out(f"leaderboard: {options.out / 'index.html'}, {len(rows)} rows", highlight=False)
    return shared.EXIT_FAILED if refuted else 0


def _command(options: argparse.Namespace) -> str:
    """Return the command that makes the same page."""
    words = ["lpv-track", "leaderboard", *map(str, options.folders), "--out", str(options.out)]
    if options.sample != SAMPLE:
        words += ["--sample", str(options.sample)]
    if options.seed:
        words += ["--seed", str(options.seed)]
    if options.title != "Leaderboard":
        words += ["--title", options.title]
    if options.open_named_files:
        words.append("--open-named-files")
    return shlex.join(words)
