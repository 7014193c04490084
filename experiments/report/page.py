"""The page around a report: one file with its own style and scripts, which may fetch nothing."""

import base64
import hashlib
import html
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from string import Template

PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="$policy">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
$style</style>
</head>
<body>
<main>
<header>
<h1>$title</h1>
<p class="soft">$subtitle</p>
<nav aria-label="Contents">$contents</nav>
</header>
$body
</main>
$scripts
</body>
</html>
""")
SCRIPTS = ("page.js",)
"""What every page runs: choice of colours, sorting of tables."""


@cache
def asset(name: str) -> str:
    """Text of a file beside this module.

    Raises
    ------
    FileNotFoundError
        If the installation lacks it.
    """
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def render_page(
    title: str, subtitle: str, contents: str, body: str, scripts: Sequence[str] = ()
) -> str:
    """The whole page as text.

    Its policy forbids every request, and every script but the page's own, which it knows by their
    digests: what a results folder brings along cannot run.

    Parameters
    ----------
    title, subtitle
        Escaped here.
    contents, body
        HTML.
    scripts
        Names of further script files beside this module.
    """
    sources = [asset(name) for name in (*SCRIPTS, *scripts)]
    digests = [
        base64.b64encode(hashlib.sha256(f"\n{source}".encode()).digest()).decode()
        for source in sources
    ]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    policy = (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "base-uri 'none'; form-action 'none'"
    )
    return PAGE.substitute(
        policy=policy,
        title=html.escape(title),
        subtitle=html.escape(subtitle),
        style=asset("page.css"),
        contents=contents,
        body=body,
        scripts="\n".join(f"<script>\n{source}</script>" for source in sources),
    )
