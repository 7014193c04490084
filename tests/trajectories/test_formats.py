"""Recognition of formats: by content first; what is not read is refused by its name."""

import gzip
import io
import pickle
import sqlite3
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trajectories import load
from trajectories.formats import REFUSED, ROOTS, SIGNATURES, SUFFIXES, TEXT_SUFFIXES, reader_of


def numpy_file(save: Callable[..., None]) -> bytes:
    stream = io.BytesIO()
    save(stream, np.zeros((4, 2)))
    return stream.getvalue()


def zipped(*names: str) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, "x")
    return stream.getvalue()


def database(statement: str, folder: Path) -> bytes:
    with sqlite3.connect(folder / "made.db") as connection:
        connection.execute(statement)
    connection.close()
    return (folder / "made.db").read_bytes()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("x.npy", numpy_file(np.save), "a NumPy array, which is not read: use ReferencePath.from_"),
        ("x.npz", numpy_file(np.savez), "a NumPy archive"),
        ("x.pkl", pickle.dumps([1.0]), "a Python pickle, which is not read: loading it could run"),
        ("x.pkl", pickle.dumps([1.0], protocol=0), "a Python pickle"),
        ("x.csv", pickle.dumps({"x": 1}), "a Python pickle"),
        ("x.pt", zipped("archive/data.pkl"), "a Python pickle"),
        ("x.xlsx", zipped("[Content_Types].xml", "xl/workbook.xml"), "an Excel workbook"),
        ("x.csv", zipped("[Content_Types].xml", "xl/workbook.xml"), "an Excel workbook"),
        ("x.kmz", zipped("doc.kml"), "a KMZ archive, which is not read: unpack it"),
        ("x.zip", zipped("a.csv"), "a ZIP archive"),
        ("x.csv.gz", gzip.compress(b"x,y\n", mtime=0), "a compressed file"),
        ("x.mat", b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "a MATLAB file"),
        ("x.mat", b"\0\0\0\0\1\0\0\0", "a MATLAB file"),
        ("x.h5", b"\x89HDF\r\n\x1a\n\0", "an HDF5 file"),
        ("x.parquet", b"PAR1\x15\x04\0", "a Parquet table"),
        ("x.bag", b"#ROSBAG V2.0\n\0", "a ROS 1 bag, which is not read: lpv-track bag reference"),
        ("x.mcap", b"\x89MCAP0\r\n\0", "an MCAP recording, which is not read: lpv-track bag"),
        ("x.fit", b"\x0e\x10\xd9\x07\0\0\0\0.FIT\0\0", "a FIT track, which is not read: export"),
        ("x.shp", b"\0\0\x27\x0a\0\0", "a shapefile"),
        ("x.png", b"\x89PNG\r\n\x1a\n\0", "a picture, which is not read: occupancy maps"),
        ("map.pgm", b"P5\n4 4\n255\n\0\0", "a picture"),
        ("x.pdf", b"%PDF-1.7\n", "a PDF document"),
        ("x.vbo", b"File created\n[column names]\nsats time lat long\n", "a VBOX log"),
        ("x.mf4", b"MDF     4.10    ", "an MDF measurement"),
        ("x.pcd", b"# .PCD v0.7\nFIELDS x y z\n", "a point cloud"),
        ("x.yaml", b"image: map.pgm\nresolution: 0.05\n", "a YAML file"),
        ("x.osm", b'<?xml version="1.0"?>\n<osm version="0.6"></osm>', "OpenStreetMap or Lanelet2"),
        ("x.pbf", b"\0\0\0\x0d\n\tOSMHeader", "OpenStreetMap or Lanelet2 map"),
        ("x.net.xml", b"<!-- made by netconvert -->\n<net version='1'/>", "a SUMO network"),
        ("x.xosc", b'<?xml version="1.0"?><OpenSCENARIO/>', "an OpenSCENARIO scenario"),
        ("x.tcx", b"<TrainingCenterDatabase/>", "a TCX track, which is not read: export it as"),
        ("x.csv", b"<!DOCTYPE html>\n<html><head/></html>", "a web page"),
        ("x.xml", b"<a:route/>", "is XML with the root 'route', which is not read: gpx, kml,"),
    ],
)  # fmt: skip
def test_other_formats_are_refused_by_name(
    name: str, content: bytes, words: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError) as raised:  # noqa: PT011
        reader_of(tmp_path / name, content)
    message = str(raised.value)
    assert words in message
    assert message.startswith(str(tmp_path / name))
    assert len(message.removeprefix(str(tmp_path))) < 300
    assert message.isprintable()


def test_databases_are_told_apart(tmp_path: Path) -> None:
    for statement, words in (
        ("CREATE TABLE topics(id INTEGER PRIMARY KEY)", "a rosbag2 database"),
        ("CREATE TABLE gpkg_contents(table_name TEXT)", "a GeoPackage"),
        ("CREATE TABLE points(x REAL)", "a SQLite database"),
    ):
        folder = tmp_path / words
        folder.mkdir()
        content = database(statement, folder)
        with pytest.raises(ValueError, match=words):
            reader_of(tmp_path / "x.db", content)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.csv", b"x_m,y_m\n0,0\n"),
        ("x.mat", b"  1.0e+00  2.0e+00\n"),  # MATLAB's save -ascii
        ("x.csv", b'# format: "refpath/1"\n'),
        ("x.csv", "Höhe;x;y\n".encode("latin-1")),
        ("x.csv", "x,y\n".encode("utf-16")),
        ("x.bin", b"\0\1\2\3"),
        ("x.dat", b""),
        ("x.csv", b"P2,P5\n"),
        ("x.csv", b"$x,$y\n"),
    ],
)  # fmt: skip
def test_text_tables_and_unknown_bytes_are_left_to_others(name: str, content: bytes) -> None:
    assert reader_of(Path(name), content) is None


def test_every_refused_format_has_its_advice() -> None:
    named = {name for _, name in SIGNATURES} | set(ROOTS.values())
    named |= set(SUFFIXES.values()) | set(TEXT_SUFFIXES.values())
    assert named <= set(REFUSED)


@pytest.mark.parametrize("suffix", ["gpx", "kml", "xodr"])
def test_a_root_behind_a_long_comment_is_known_by_the_suffix(suffix: str) -> None:
    head = b'<?xml version="1.0"?><!--' + b" " * 70_000
    assert reader_of(Path(f"x.{suffix}"), head) is not None
    with pytest.raises(ValueError, match="is XML with the root ''"):
        reader_of(Path("x.xml"), head)


def test_the_folder_of_a_bag_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    with pytest.raises(ValueError, match="is a ROS 2 bag, which is not read: lpv-track bag"):
        load(tmp_path)
    with pytest.raises(ValueError, match="cannot be read"):
        load(tmp_path / "metadata")
