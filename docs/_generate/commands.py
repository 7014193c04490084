"""The command reference in Markdown, from the parsers of `lpv-track` themselves."""

import argparse
import html
from collections.abc import Iterator

HELP = "-h"


def command_reference(root: argparse.ArgumentParser) -> str:
    """Markdown of every command of a parser with subparsers, those of subcommands included."""
    lines = []
    for parser, depth in walk(root):
        lines += [f"{'#' * (depth + 2)} `{parser.prog}`", "", text(parser.description), ""]
        if rows := list(options(parser)):
            lines += ["| option | meaning |", "|---|---|", *rows, ""]
        if parser.epilog:
            lines += ["```sh", parser.epilog.removeprefix("example:").strip(), "```", ""]
    return "\n".join(lines)


def walk(root: argparse.ArgumentParser) -> Iterator[tuple[argparse.ArgumentParser, int]]:
    """Every parser below the root and how deep it lies, 0 for the commands."""
    for parser in subparsers(root):
        yield parser, 0
        yield from ((inner, depth + 1) for inner, depth in walk(parser))


def subparsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """Parsers of a parser's subcommands, in their order."""
    found = []
    for action in parser._actions:  # noqa: SLF001  argparse has no public way to list them
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            found += list(action.choices.values())
    return found


def options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Rows of a parser's table, an argument each."""
    for action in parser._actions:  # noqa: SLF001
        if HELP in action.option_strings or isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            continue
        yield f"| {names(action)} | {text(meaning(action))} |"


def names(action: argparse.Action) -> str:
    """How an argument is written on the command line, as HTML that may break between names."""
    value = "" if action.nargs == 0 else metavar(action)
    if not action.option_strings:
        return f"`{value}`"
    return "<br>".join(f"`{name} {value}`".replace(" `", "`") for name in action.option_strings)


def metavar(action: argparse.Action) -> str:
    """What stands for an argument's value."""
    if isinstance(action.metavar, str):
        name = action.metavar
    elif action.choices is not None:
        name = ",".join(map(str, action.choices))
        name = f"{{{name}}}"
    else:
        name = action.dest.upper()
    return {"+": f"{name} ...", "*": f"[{name} ...]", "?": f"[{name}]"}.get(str(action.nargs), name)


def meaning(action: argparse.Action) -> str:
    """An argument's help, and its default where the help does not say it."""
    said = action.help or ""
    shown = action.default
    told = "default" in said or shown is None or shown is False or shown in ([], "")
    if told or not action.option_strings:
        return said
    value = " ".join(map(str, shown)) if isinstance(shown, list | tuple) else str(shown)
    return f"{said}; default {value}".removeprefix("; ")


def text(words: str | None) -> str:
    """Words of a parser as Markdown that shows just these."""
    return html.escape(words or "", quote=False).replace("|", "\\|").replace("*", "\\*")
