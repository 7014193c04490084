"""Makes griffe read docstrings as Markdown (see `docstrings`) and show forwarded arguments."""

import importlib.util
from pathlib import Path
from typing import Any

import griffe

# griffe loads this file by its path, so the one beside it is loaded by its path, too.
_spec = importlib.util.spec_from_file_location(
    "docstrings_as_markdown", Path(__file__).with_name("docstrings.py")
)
assert _spec is not None
assert _spec.loader is not None
_docstrings = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_docstrings)


class MarkdownDocstrings(griffe.Extension):
    """Rewrites every docstring as it is found."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite one."""
        if obj.docstring is not None:
            obj.docstring.value = _docstrings.markdown(obj.docstring.value)


class ForwardedArguments(griffe.Extension):
    """Shows the parameter of `validation.forwards_arguments` as `**settings`, which callers see."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Move the parameter to the end, if a function has the decorator."""
        if any("forwards_arguments" in str(decorator.value) for decorator in func.decorators):
            own = [parameter for parameter in func.parameters if parameter.name != "settings"]
            kind = griffe.ParameterKind.var_keyword
            func.parameters = griffe.Parameters(*own, griffe.Parameter("settings", kind=kind))
