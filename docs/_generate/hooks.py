"""What the site makes of the project's own sources, so that it cannot drift from them.

The start page is README.md; the command reference is made of the parsers; `<!-- erratum N -->`
becomes the Nth of the errata that reports print. Formulas become drawings, which need neither
scripts nor fonts.
"""

import html
import re
import warnings
from pathlib import Path
from typing import Any

from commands import command_reference
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from experiments.cli import parser
from experiments.report.build import ERRATA

with warnings.catch_warnings():
    # It finds its font by a function that Python 3.11 deprecated, and 3.13 took back into favour.
    warnings.filterwarnings("ignore", "path is deprecated", DeprecationWarning)
    from ziamath.config import config as drawing_config
    from ziamath.zmath import Math

drawing_config.svg2 = False  # each drawing whole: no ids that could be those of another
ROOT = Path(__file__).parents[2]
ERRATUM = re.compile(r"<!-- erratum (\d+) -->")
FORMULA = re.compile(r"^\$\$\n(.*?)\n\$\$$", re.DOTALL | re.MULTILINE)
FORMULA_SIZE = 17
"""px."""
FETCHED = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
COMMANDS = "<!-- commands -->"
FROM_ROOT = {
    "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
}  # fmt: skip


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
    markdown = FORMULA.sub(lambda match: drawn(match[1]), markdown)
    return markdown.replace(COMMANDS, command_reference(parser()))


def on_post_page(output: str, page: Page, **_: Any) -> str:
    """Refuse a page that a browser would fetch something for from another server."""
    if found := FETCHED.search(output):
        raise PluginError(f"{page.file.dest_uri} asks another server for {found[0]}")
    return output


def drawn(formula: str) -> str:
    """A formula in LaTeX as SVG in the text's colour, its source for those who listen."""
    drawing = Math.fromlatex(formula, size=FORMULA_SIZE, color="currentColor").svg()
    return f'<div class="formula" role="img" aria-label="{html.escape(formula)}">{drawing}</div>'
