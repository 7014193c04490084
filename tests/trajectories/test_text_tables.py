"""Tables of points as other tools write them: separators, headers, units, decimal commas."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest

from trajectories import ReferencePath, load
from trajectories.columns import known

ANGLE = 2.0 * math.pi * np.arange(120) / 120
ELLIPSE = np.column_stack([60.0 * np.cos(ANGLE), 30.0 * np.sin(ANGLE)])
LENGTH = 290.65
"""m: circumference of the ellipse, 290.67 by Ramanujan's formula, less what smoothing takes."""


def written(folder: Path, text: str, name: str = "points.csv") -> Path:
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


def rows(*columns: object, separator: str = ",", form: str = "{:.6f}") -> str:
    """Lines of the ellipse's x and y, and of further columns, one value or one for each row."""
    table = np.column_stack([ELLIPSE, *(np.broadcast_to(c, 120) for c in columns)])
    lines = (separator.join(form.format(value) for value in row) for row in table.tolist())
    return "\n".join(lines) + "\n"


def is_ellipse(path: ReferencePath) -> bool:
    away = np.abs((path.x / 60.0) ** 2 + (path.y / 30.0) ** 2 - 1.0)
    return path.closed and abs(path.length - LENGTH) < 0.1 and bool(away.max() < 0.01)


@pytest.mark.parametrize(
    "text",
    [
        rows(separator=" "),
        rows(separator="\t"),
        rows(separator="  ", form="{:.18e}"),  # numpy.savetxt, MATLAB's -ascii
        rows(separator="; "),
        rows(separator=";", form="{:.3f}").replace(".", ","),
        rows(separator="\t", form="{:.3f}").replace(".", ","),
        rows(separator=" ", form="{:.3f}").replace(".", ","),
        "x y\n" + rows(separator=" "),
        "# x y\n" + rows(),
        "% written by a tool\n" + rows(),
        "Session;2026\n" + "x;y\n" + rows(separator=";"),
        '"x","y"\n' + rows().replace("60.000000,", '"60.000000",', 1),
        "X [m],Y [m]\n" + rows(),
        "x (mm),y (mm)\n" + "".join(f"{1e3 * x:.1f},{1e3 * y:.1f}\n" for x, y in ELLIPSE),
        "utm_e,utm_n\n" + rows(),
        "field.pose.pose.position.x,field.pose.pose.position.y\n" + rows(),
        "/odom/pose/pose/position/x,/odom/pose/pose/position/y\n" + rows(),
        "\tx\ty\n" + "".join(f"{k}\t{x}\t{y}\n" for k, (x, y) in enumerate(ELLIPSE)),  # pandas
        rows().replace("\n", "\r\n"),
        "\ufeff" + rows(),
    ],
    ids=lambda text: text[:18],
)  # fmt: skip
def test_two_columns_are_read_however_they_are_separated(text: str, tmp_path: Path) -> None:
    assert is_ellipse(load(written(tmp_path, text, "points.txt")))


@pytest.mark.parametrize(
    ("header", "columns", "speed"),
    [
        ("x,y,v", (3.0,), 3.0),
        ("x,y,z,yaw,velocity,change_flag", (10.0, 0.0, 12.0, 0.0), 12.0),  # Autoware
        ("X,Y,Z,A,C,V", (0.2, 1.6, 0.0, 7.0), 7.0),  # OpenPlanner, for CARLA and Autoware
        ("x,y,v_kmh", (36.0,), 10.0),
        ("x,y,Speed (km/h)", (36.0,), 10.0),
        ("x,y,Speed [mph]", (10.0,), 4.4704),
        ("x,y,speed_kn", (10.0,), 5.144444),
        ("x,y,vx,vy", (3.0, 4.0), 5.0),
        ("x,y,vx_mps,ax_mps2", (3.0, 0.0), 3.0),
        ("# x_m,y_m,w_tr_right_m,w_tr_left_m,vx_racetraj_mps", (4.0, 4.0, 20.0), 20.0),
    ],
)
def test_speeds_are_found_by_name_and_unit(
    header: str, columns: tuple[float, ...], speed: float, tmp_path: Path
) -> None:
    path = load(written(tmp_path, f"{header}\n{rows(*columns)}"))
    assert is_ellipse(path)
    np.testing.assert_allclose(path.speed, speed, rtol=1e-6)
    assert path.metadata["speeds"] == "file"


def test_a_raceline_of_the_tum_has_comments_before_its_header(tmp_path: Path) -> None:
    text = (
        "# 1b2c-uuid\n# hash of the ggv\n# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2\n"
    )
    s = 2.42 * np.arange(120)
    values = np.column_stack([s, ELLIPSE, s, s, np.full(120, 3.0), s]).tolist()
    lines = "\n".join("; ".join(f"{value:.7f}" for value in row) for row in values)
    path = load(written(tmp_path, text + lines))
    assert is_ellipse(path)
    np.testing.assert_allclose(path.speed, 3.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_racing_line_lies_beside_its_reference_line(side: float, tmp_path: Path) -> None:
    """The TUM's normal vectors point to the right, so that widths change with the offset."""
    names = "x_ref_m y_ref_m width_right_m width_left_m x_normvec_m y_normvec_m alpha_m"
    header = f"# {'; '.join([*names.split(), 's_racetraj_m', 'vx_racetraj_mps'])}\n"
    radius, offset = 50.0, side * 2.0
    outwards = np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])  # right of counter-clockwise
    columns = [radius * outwards, np.full((120, 2), 4.0), outwards, np.full((120, 1), offset)]
    table = np.column_stack([*columns, np.zeros(120), np.full(120, 20.0)]).tolist()
    lines = "\n".join("; ".join(map(repr, row)) for row in table)
    path = load(written(tmp_path, header + lines), smoothing=0.0)
    np.testing.assert_allclose(np.hypot(path.x, path.y), radius + offset, atol=1e-3)
    assert path.widths is not None
    np.testing.assert_allclose(path.widths, np.tile([4.0 - offset, 4.0 + offset], (len(path.x), 1)))
    np.testing.assert_allclose(path.speed, 20.0)


def test_a_phone_log_is_read_with_its_speeds(tmp_path: Path) -> None:
    north, east = 111_205.0, 74_445.0  # m per degree at 48.15 degrees, within 0.1 %
    header = '"Time (s)","Latitude (°)","Longitude (°)","Height (m)","Velocity (m/s)"\n'
    degrees = (48.15 + ELLIPSE[:, 1] / north, 11.57 + ELLIPSE[:, 0] / east)
    table = np.column_stack([np.arange(120.0), *degrees, np.full((120, 2), [500.0, 5.0])])
    lines = "\n".join(",".join(f"{value:.8f}" for value in row) for row in table.tolist())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = load(written(tmp_path, header + lines))
    assert path.closed
    assert path.length == pytest.approx(290.7, rel=2e-3)
    np.testing.assert_allclose(path.speed, 5.0)


def test_columns_are_named_by_the_user(tmp_path: Path) -> None:
    file = written(tmp_path, rows(7.0, 36.0, separator=" "))
    with pytest.raises(
        ValueError, match=r"4 columns without a header: .* --columns x y - - --write"
    ):
        load(file)
    path = load(file, columns=("x", "y", "-", "v_kmh"))
    assert is_ellipse(path)
    np.testing.assert_allclose(path.speed, 10.0)
    with pytest.raises(ValueError, match="has 4 columns, but 2 are named"):
        load(file, columns=("x", "y"))
    with pytest.raises(ValueError, match="column name 'wheel' is not known: known are x, y, v"):
        load(file, columns=("x", "y", "-", "wheel"))
    # They replace a header, too.
    other = written(tmp_path, "a,b,c\n" + rows(2.0))
    np.testing.assert_allclose(load(other, columns=["x", "y", "v"]).speed, 2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "x,y,v\n" + rows(math.nan).replace("nan", "fast"),
            "line 2, column v: 'fast' is not a number",
        ),
        ("x,y,v\n" + rows(-1.0), "line 2: speed -1 m/s is not from 0 to 200; speeds='planned'"),
        ("x,y,v (furlongs)\n" + rows(3.0), r"name 'v \(furlongs\)' is none of m/s, mps"),
        ("x (ell),y (ell)\n" + rows(), r"name 'x \(ell\)' is none of m, km, cm, mm"),
        ("x;y\n1.060,00;1,5\n" + rows(separator=";"), "line 2 has 3 columns, not 2"),
        ("x;y\n1.060,00;1\n" + rows(separator=";"), "line 2, .* '1.060,00' is not a number"),
        ("t,x,y\n0,,\n" + rows(1.0), "line 2, column x: '' is not a number"),
        ("t,lat,lon\n0,,\n1,48,\n", "line 3, column lon: '' is not a number"),
        ("x,y,v\n" + rows(), "line 2 has 2 columns, not 3"),
        ('"x,y\n' * 3, "no rows of numbers"),
    ],
)
def test_what_cannot_be_read_is_named(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        load(written(tmp_path, text))
    assert str(caught.value).isprintable()


def test_names_of_columns_hold_quantity_and_unit() -> None:
    for name, quantity, factor in (
        ("x_m", "x", 1.0), ("East (km)", "x", 1e3), ("y_ref_m", "y", 1.0),
        ("latitude_rad", "latitude", math.degrees(1.0)), ("t_ms", "time", 1e-3),
        ("VX_MPS", "speed", 1.0), ("speed_km_h", "speed", 1 / 3.6), ("w_tr_left", "width_left", 1),
    ):  # fmt: skip
        found = known(name)
        assert found is not None
        assert (found.quantity, found.factor) == (quantity, pytest.approx(factor))
    for name in ("", "-", "yaw", "psi_rad", "x_kg", "()", "acceleration_x", "\n"):
        assert known(name) is None


@pytest.mark.parametrize(
    "text",
    [
        "x,y\nm,m\n" + rows(),
        "x,y,note\n[m],[m],\n" + rows(0.0),
        "# y [m]  x [m]\n" + "".join(f"{y:.6f}  {x:.6f}\n" for x, y in ELLIPSE),
        "x,y\n,\n" + rows(),
        "x,y\nmm,mm\n" + "".join(f"{1e3 * x:.1f},{1e3 * y:.1f}\n" for x, y in ELLIPSE),
        "x,y\n" + rows().replace("\n", ",\n"),
        rows().replace("\n", ",\n"),
        "x,y\r" + rows().replace("\n", "\r"),
        "sep=;\nx;y\n" + rows(separator=";", form="{:.3f}").replace(".", ","),
    ],
    ids=[
        "units",
        "brackets",
        "blanks",
        "empty",
        "mm",
        "last comma",
        "last comma without header",
        "CR",
        "Excel's sep",
    ],
)
def test_lines_of_units_last_separators_and_old_line_ends(text: str, tmp_path: Path) -> None:
    assert is_ellipse(load(written(tmp_path, text)))


def test_speeds_take_the_unit_of_the_line_below_their_name(tmp_path: Path) -> None:
    path = load(written(tmp_path, "x,y,v\nm,m,km/h\n" + rows(14.4)))
    np.testing.assert_allclose(path.speed, 4.0, rtol=1e-6)
    with pytest.raises(ValueError, match=r"the unit in the column's name 'x \[ft\]' is none of m"):
        load(written(tmp_path, "x,y,v\nft,ft,km/h\n" + rows(14.4)))


@pytest.mark.parametrize("header", ["x,y,x,y", "/a/position/x,/a/position/y,/b/position/x,z"])
def test_two_columns_that_may_be_meant_are_refused(header: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"columns '.*x' and '.*x' may both be the x: name the"):
        load(written(tmp_path, f"{header}\n" + rows(0.0, 1.0)))
    with pytest.raises(ValueError, match="distinct points"):
        load(written(tmp_path, f"{header}\n" + rows(0.0, 1.0)), columns=["-", "-", "x", "y"])


def test_decimal_commas_between_commas_are_refused(tmp_path: Path) -> None:
    text = rows(separator=", ", form="{:.3f}").replace(".", ",")
    for header in ("# east (m), north (m)\n", "east (m), north (m)\n", ""):
        with pytest.raises(ValueError, match="column"):
            load(written(tmp_path, header + text))


def test_times_of_day_are_times(tmp_path: Path) -> None:
    steps = np.hypot(*np.diff(ELLIPSE, axis=0).T)
    seconds = np.concatenate([[0.0], np.cumsum(steps)]) / 4.0
    lines = [
        f"2026-05-01;10:{int(t) // 60:02d}:{t % 60:06.3f};{x:.6f};{y:.6f};14.4"
        for t, (x, y) in zip(seconds.tolist(), ELLIPSE.tolist(), strict=True)
    ]
    file = written(tmp_path, "date;time;x;y;speed\n" + "\n".join(lines))
    with pytest.warns(UserWarning, match="if they are in km/h"):
        path = load(file)
    assert path.speed.max() == pytest.approx(14.4, rel=1e-6)


def test_rows_before_the_first_fix_are_left_out(tmp_path: Path) -> None:
    degrees = np.column_stack([48.0 + ELLIPSE[:, 1] / 111_200.0, 11.0 + ELLIPSE[:, 0] / 74_600.0])
    lines = "".join(f"{k},{a:.8f},{o:.8f}\n" for k, (a, o) in enumerate(degrees.tolist()))
    path = load(written(tmp_path, "t,lat,lon\n-2,,\n-1,,\n" + lines))
    assert path.closed
    assert "; 2 rows without a position left out; " in path.metadata["imported"]
