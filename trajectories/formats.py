"""Recognise the format of a file of points, by its content first and its name second.

Text tables and native files are no business of this module: `reader_of` returns None for them. What
is neither a table nor read here is refused by the name of its format, with what to do instead.
"""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, TypeAlias

from trajectories import geodata, road_maps
from trajectories.arguments import shortened, shown
from trajectories.raw_path import RawPath

Reader: TypeAlias = Callable[[Path, str | None], RawPath]
"""Function of a file and the option `part` (None takes the longest piece)."""

HEAD = 65_536
"""First bytes of a file that recognition needs at most."""

READERS: dict[str, Reader] = {
    "gpx": geodata.read_gpx,
    "kml": geodata.read_kml,
    "geojson": geodata.read_geojson,
    "nmea": geodata.read_nmea,
    "OpenDRIVE": road_maps.read_opendrive,
    "commonRoad": road_maps.read_commonroad,
}
"""Readers by the name of an XML file's root, or of the format."""

CSV = "write its points as a CSV file with the columns x_m,y_m (m) or lat,lon (deg)"
ARRAY = "load it yourself and use ReferencePath.from_waypoints(array)"
UNPACK = "unpack it and give the file inside"
BAG = "lpv-track bag reference FILE --out path.csv makes a path of it"
GEOJSON = "export it as GeoJSON in WGS-84"

REFUSED = {
    # Recordings
    "ROS 1 bag": BAG,
    "MCAP recording": BAG,
    "rosbag2 database": BAG,
    "ROS 2 bag": BAG,
    "MDF measurement": CSV,
    "VBOX log": "export it as GPX or CSV",
    # Arrays and tables
    "NumPy array": "use ReferencePath.from_waypoints(numpy.load(file))",
    "NumPy archive": "use ReferencePath.from_waypoints(numpy.load(file)[key])",
    "MATLAB file": "use ReferencePath.from_waypoints(scipy.io.loadmat(file)[name]), or writematrix "
    "in MATLAB",
    "HDF5 file": ARRAY,
    "Python pickle": f"loading it could run any code; {CSV}",
    "Parquet table": CSV,
    "Arrow table": CSV,
    "Excel workbook": "save the sheet as CSV UTF-8",
    "spreadsheet": "save the sheet as CSV",
    "SQLite database": CSV,
    "YAML file": CSV,
    # Maps and tracks
    "OpenStreetMap or Lanelet2 map": "convert it to OpenDRIVE (.xodr) or CommonRoad (.xml)",
    "SUMO network": "netconvert --opendrive-output writes it as OpenDRIVE",
    "SUMO file": CSV,
    "OpenSCENARIO scenario": "give the OpenDRIVE file (.xodr) of its road network",
    "TCX track": "export it as GPX",
    "FIT track": "export it as GPX",
    "GML file": GEOJSON,
    "KMZ archive": "unpack it and give its doc.kml",
    "shapefile": GEOJSON,
    "GeoPackage": GEOJSON,
    "FlatGeobuf file": GEOJSON,
    "TopoJSON file": GEOJSON,
    "CAD drawing": CSV,
    "point cloud": f"it has no points in order: {CSV}",
    # Pictures, documents, archives
    "picture": f"occupancy maps and pictures have no points in order: {CSV}",
    "PDF document": CSV,
    "web page": "download the file itself",
    "ZIP archive": UNPACK,
    "compressed file": UNPACK,
}
"""Formats that are not read: name, and what to do."""

SIGNATURES = (
    (b"#ROSBAG V", "ROS 1 bag"),
    (b"\x89MCAP0\r\n", "MCAP recording"),
    (b"MDF     ", "MDF measurement"),
    (b"SQLite format 3\0", "SQLite database"),
    (b"\x93NUMPY", "NumPy array"),
    (b"MATLAB 5.0 MAT-file", "MATLAB file"),
    (b"MATLAB 7.3 MAT-file", "MATLAB file"),
    (b"\x89HDF\r\n\x1a\n", "HDF5 file"),
    (b"\x80\x02", "Python pickle"),
    (b"\x80\x03", "Python pickle"),
    (b"\x80\x04", "Python pickle"),
    (b"\x80\x05", "Python pickle"),
    (b"PAR1\x15", "Parquet table"),
    (b"ARROW1\0", "Arrow table"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "Excel workbook"),
    (b"\0\0\x27\x0a", "shapefile"),
    (b"fgb\x03", "FlatGeobuf file"),
    (b"# .PCD", "point cloud"),
    (b"ply\n", "point cloud"),
    (b"LASF", "point cloud"),
    (b"\x89PNG\r\n", "picture"),
    (b"\xff\xd8\xff", "picture"),
    (b"GIF87a", "picture"),
    (b"GIF89a", "picture"),
    (b"II*\0", "picture"),
    (b"MM\0*", "picture"),
    (b"P2\n", "picture"),
    (b"P5\n", "picture"),
    (b"P6\n", "picture"),
    (b"%PDF-", "PDF document"),
    (b"PK\x03\x04", "ZIP archive"),
    (b"\x1f\x8b", "compressed file"),
    (b"BZh91AY&SY", "compressed file"),
    (b"\xfd7zXZ\0", "compressed file"),
    (b"\x28\xb5\x2f\xfd", "compressed file"),
    (b"7z\xbc\xaf", "compressed file"),
    (b"Rar!\x1a", "compressed file"),
)
"""First bytes of files that are not read."""

CONTAINERS = {
    "ZIP archive": (
        (b"xl/", "Excel workbook"), (b".npy", "NumPy archive"), (b"doc.kml", "KMZ archive"),
        (b"opendocument.spreadsheet", "spreadsheet"), (b"data.pkl", "Python pickle"),
    ),
    "SQLite database": ((b"CREATE TABLE topics", "rosbag2 database"), (b"gpkg_", "GeoPackage")),
}  # fmt: skip
"""Formats inside general ones, and what tells them in the first bytes."""

ROOTS = {
    "osm": "OpenStreetMap or Lanelet2 map",
    "net": "SUMO network",
    "routes": "SUMO file",
    "additional": "SUMO file",
    "OpenSCENARIO": "OpenSCENARIO scenario",
    "TrainingCenterDatabase": "TCX track",
    "FeatureCollection": "GML file",
    "svg": "picture",
    "html": "web page",
}
"""Root elements of XML files that are not read."""

SUFFIXES = {
    ".bag": "ROS 1 bag", ".mcap": "MCAP recording", ".db3": "rosbag2 database",
    ".npy": "NumPy array", ".npz": "NumPy archive", ".mat": "MATLAB file",
    ".h5": "HDF5 file", ".hdf5": "HDF5 file", ".parquet": "Parquet table",
    ".feather": "Arrow table", ".pkl": "Python pickle", ".pickle": "Python pickle",
    ".xlsx": "Excel workbook", ".xls": "Excel workbook", ".ods": "spreadsheet",
    ".pbf": "OpenStreetMap or Lanelet2 map", ".fit": "FIT track", ".kmz": "KMZ archive",
    ".shp": "shapefile", ".dbf": "shapefile", ".shx": "shapefile", ".gpkg": "GeoPackage",
    ".fgb": "FlatGeobuf file", ".dwg": "CAD drawing", ".pgm": "picture", ".bmp": "picture",
}  # fmt: skip
"""Formats that are not read, by the suffix of files that are no text and have no signature."""
TEXT_SUFFIXES = {
    ".yaml": "YAML file", ".yml": "YAML file", ".dxf": "CAD drawing",
    ".pkl": "Python pickle", ".pickle": "Python pickle",
}  # fmt: skip
"""Formats that are not read, by the suffix of text files."""
NMEA_SUFFIXES = (".nmea", ".ubx", ".nma")
"""Suffixes of logs whose sentences may stand between binary messages or behind times."""
XML_SUFFIXES = {".gpx": "gpx", ".kml": "kml", ".xodr": "OpenDRIVE"}
"""Roots of XML files by suffix, for those that begin with more than `HEAD` bytes of comments."""

_ROOT = re.compile(r"\s*<(?:[\w.-]+:)?(?P<name>[\w.-]+)")
_BEFORE_ROOT = re.compile(
    r"\s*(?:<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>\[]*(?:\[.*?\])?\s*>)", re.DOTALL
)
_SENTENCE = re.compile(r"[$!](?:[A-Z]{2}[A-Z]{3}|P[A-Z]{3}),")
_POSITION = re.compile(rb"\$[A-Z]{2}(?:GGA|RMC|GNS|GLL),")


def refuse_folder(file: Path) -> None:
    """Refuse the folder of a ROS 2 bag by its name."""
    if os.path.isfile(file / "metadata.yaml"):  # noqa: PTH113  Path's raises for long names
        _refuse(file, "ROS 2 bag")


def reader_of(file: Path, head: bytes) -> Reader | None:
    """Return the reader of a file's format; None for a text table or a native file.

    Parameters
    ----------
    file
        File, whose suffix counts where the content does not tell.
    head
        Its first bytes, `HEAD` of them, or all.

    Raises
    ------
    ValueError
        For a format that is not read, in one line that names it and says what to do.
    """
    head, suffix = head[:HEAD], file.suffix.lower()
    _refuse_signature(file, head)
    if suffix in NMEA_SUFFIXES and _POSITION.search(head):
        return READERS["nmea"]
    wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
    if b"\0" in head and not wide:
        if suffix in SUFFIXES:
            _refuse(file, SUFFIXES[suffix])
        return None
    text = head.decode("utf-16" if wide else "utf-8-sig", errors="replace").lstrip()
    if text.startswith("<"):
        return _xml_reader(file, text)
    if text.startswith(("{", "[")):
        if re.search(r'"type"\s*:\s*"Topology"', text):
            _refuse(file, "TopoJSON file")
        return READERS["geojson"]
    if _SENTENCE.match(text):
        return READERS["nmea"]
    if "[column names]" in text:
        _refuse(file, "VBOX log")
    if suffix in TEXT_SUFFIXES:
        _refuse(file, TEXT_SUFFIXES[suffix])
    return None


def _refuse_signature(file: Path, head: bytes) -> None:
    """Refuse a file whose first bytes name a format that is not read."""
    name = next((name for start, name in SIGNATURES if head.startswith(start)), None)
    if name is None and head[8:12] == b".FIT":
        name = "FIT track"
    if name is None:
        return
    for mark, inner in CONTAINERS.get(name, ()):
        if mark in head or SUFFIXES.get(file.suffix.lower()) == inner:
            _refuse(file, inner)
    _refuse(file, name)


def _xml_reader(file: Path, text: str) -> Reader:
    """Return the reader of an XML file by its root element, or by its suffix if that is far."""
    start = 0
    while found := _BEFORE_ROOT.match(text, start):
        start = found.end()
    match = _ROOT.match(text, start)
    root = match["name"] if match else XML_SUFFIXES.get(file.suffix.lower(), "")
    if root in READERS:
        return READERS[root]
    if (name := ROOTS.get(root if root != "HTML" else "html")) is not None:
        _refuse(file, name)
    raise ValueError(
        f"{shortened(file)}: is XML with the root {shown(root)}, which is not read: gpx, kml, "
        "OpenDRIVE and commonRoad are"
    )


def _refuse(file: Path, name: str) -> NoReturn:
    article = "an" if name[0] in "AEO" or name[:2] in {"MC", "MD", "HD"} else "a"
    raise ValueError(f"{shortened(file)}: is {article} {name}, which is not read: {REFUSED[name]}")
