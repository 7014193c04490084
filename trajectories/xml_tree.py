"""Read XML that anybody may have written: no document types, so no entities, and bounded in size.

A document type declares entities, which may name files, addresses, or texts that grow a
thousandfold at each use. The formats that are read here need none, so every one is refused.
"""

from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from trajectories.arguments import shortened
from trajectories.fileio import read_bytes
from trajectories.text_table import MOST_BYTES

MOST_ELEMENTS, DEEPEST = 2_000_000, 100
"""Most elements of a file, some 100 bytes each, and most of them inside each other."""


class _Builder(TreeBuilder):
    """Build a tree whose tags have no namespaces, and refuse what is not bounded."""

    def __init__(self) -> None:
        super().__init__()
        self._count = self._depth = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> Element:
        self._count += 1
        self._depth += 1
        if self._count > MOST_ELEMENTS:
            raise ValueError(f"more than {MOST_ELEMENTS} elements are not read")
        if self._depth > DEEPEST:
            raise ValueError(f"more than {DEEPEST} elements inside each other are not read")
        return super().start(tag.rpartition("}")[2], attrs)

    def end(self, tag: str, /) -> Element:
        self._depth -= 1
        return super().end(tag.rpartition("}")[2])

    def doctype(self, *_declared: str | None) -> NoReturn:
        raise ValueError("declares a document type, which is not read: remove its <!DOCTYPE ...>")


def read_xml(file: str | Path) -> Element:
    """Read the tree of an XML file of at most `text_table.MOST_BYTES`; tags lose their namespaces.

    Raises
    ------
    ValueError
        In one line that begins with the file's name: as `fileio.read_bytes`, for what is not
        well-formed, for a document type, and for too many elements or too deep ones.
    """
    content = read_bytes(file, MOST_BYTES)
    # A document type raises before any entity is known; others than the five of XML are errors.
    parser = XMLParser(target=_Builder())  # noqa: S314
    try:
        parser.feed(content)
        root: Element = parser.close()
    except ParseError as error:
        raise ValueError(f"{shortened(file)}: is not well-formed XML: {error}") from error
    except (ValueError, LookupError) as error:  # LookupError: its encoding is unknown
        raise ValueError(f"{shortened(file)}: {shortened(error)}") from error
    return root
