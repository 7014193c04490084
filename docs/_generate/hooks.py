"""What the site makes of the project's own sources, so that it cannot drift from them.

The start page is README.md; the command reference is made of the parsers; `<!-- erratum N -->`
becomes the Nth of the errata that reports print.
"""

import re
from pathlib import Path
from typing import Any

from commands import command_reference
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from experiments.options import parser
from experiments.report_page import ERRATA

ROOT = Path(__file__).parents[2]
ERRATUM = re.compile(r"<!-- erratum (\d+) -->")
COMMANDS = "<!-- commands -->"
FROM_ROOT = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the start page."""
    text = (ROOT / "README.md").read_text()
    for name, page in FROM_ROOT.items():
        text = text.replace(f"]({name})", f"]({page})")
    files.append(File.generated(config, "index.md", content=text.replace("](docs/", "](")))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Put in what pages ask for."""
    if page.file.src_uri == "errata.md":
        used = [int(number) for number in ERRATUM.findall(markdown)]
        if used != list(range(1, len(ERRATA) + 1)):
            raise PluginError(f"errata.md has errata {used} of {len(ERRATA)}")
        return ERRATUM.sub(lambda match: ERRATA[int(match[1]) - 1], markdown)
    return markdown.replace(COMMANDS, command_reference(parser()))
