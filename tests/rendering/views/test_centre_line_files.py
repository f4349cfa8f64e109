"""Points of centre lines in files: every kind gives the same points, and what is none is refused with its place."""

from __future__ import annotations

import json

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.rendering.views.centre_line import read_curve_points

POINTS = np.array([[1.5, -2.0, 30.0], [2.0, -1e1, 28.25], [0.0, 4.0, -7.0]])
RAS = POINTS * (-1.0, -1.0, 1.0)


def markups(points, system="LPS", **fields):
    """A curve as 3D Slicer writes it; behind its points stands one that was not set."""
    control = [{"id": str(n), "position": list(point), "positionStatus": "defined"} for n, point in enumerate(points)]
    control.append({"id": "9", "position": [0.0, 0.0, 0.0], "positionStatus": "preview"})
    return {"markups": [{"type": "Curve", "coordinateSystem": system, "controlPoints": control} | fields]}


def rows(points, separator):
    return "".join(separator.join(map(str, point)) + "\n" for point in points)


FCSV = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel\n"

FILES = {
    "blanks.txt": "# a line\n\n" + rows(POINTS, "  "),
    "tabs.dat": "\ufeff" + rows(POINTS, "\t"),
    "commas.csv": rows(POINTS, ", "),
    "semicolons.csv": rows(POINTS, ";"),
    "names.csv": "label,Z,x,Y\n" + "".join(f"p{n},{z},{x},{y}\n" for n, (x, y, z) in enumerate(POINTS)),
    "list.json": json.dumps(POINTS.tolist()),
    "object.json": json.dumps({"points": RAS.tolist(), "space": "RAS"}),
    "curve.mrk.json": json.dumps(markups(POINTS)),
    "curve_ras.mrk.json": json.dumps(markups(RAS, "RAS", coordinateUnits="mm")),
    "lps.fcsv": FCSV.format("LPS") + "".join(f"n{n},{x},{y},{z},0,0,0,1,1,1\n" for n, (x, y, z) in enumerate(POINTS)),
    "ras.fcsv": FCSV.format("0") + "".join(f"n{n},{x},{y},{z},0,0,0,1,1,1\n" for n, (x, y, z) in enumerate(RAS)),
}


@pytest.mark.parametrize(("name", "text"), FILES.items(), ids=FILES)
def test_file_of_every_kind_gives_its_points_in_lps(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")

    assert np.array_equal(read_curve_points(tmp_path / name), POINTS)


def test_frame_of_a_text_is_the_one_that_is_said(tmp_path):
    (tmp_path / "ras.txt").write_text(rows(RAS, " "))

    assert np.array_equal(read_curve_points(tmp_path / "ras.txt", "ras"), POINTS)


def test_frame_other_than_that_of_the_file_is_refused(tmp_path):
    (tmp_path / "said.mrk.json").write_text(json.dumps(markups(POINTS)))

    with refused(UsageError, "LPS", "RAS"):
        read_curve_points(tmp_path / "said.mrk.json", "ras")


def test_unknown_frame_is_refused(tmp_path):
    (tmp_path / "ras.txt").write_text(rows(RAS, " "))

    with refused(UsageError, "lps", "ras"):
        read_curve_points(tmp_path / "ras.txt", "world")


FAULTY_FILES = {
    "word in a row": ("a.txt", "1 2 3\n4 five 6\n", "line 2 is not three numbers"),
    "row of two numbers": ("a.txt", "1 2 3\n4 5\n", "line 2"),
    "one point": ("a.txt", "1 2 3\n", "1 point,"),
    "empty file": ("a.txt", "", "0 points"),
    "nan in a row": ("a.txt", "1 2 3\nnan 2 3\n", "point 1"),
    "columns of other names": ("a.csv", "a,b,c\n1,2,3\n4,5,6\n", "x, y and z"),
    "short row of a table": ("a.csv", "x,y,z\n1,2,3\n4,5\n", "line 3"),
    "cut JSON": ("a.json", "[[1, 2, 3], [1, 2", "no JSON"),
    "deep JSON": ("a.json", "[" * 100000, "no JSON"),
    "JSON without points": ("a.json", '{"point": []}', "no points"),
    "JSON of a truth value": ("a.json", "[[1, 2, 3], [1, true, 3]]", "point 1"),
    "JSON of a huge number": ("a.json", "[[1, 2, 3], [1, 2, 1" + "0" * 400 + "]]", "point 1"),
    "JSON in a grid": ("a.json", '{"points": [[1, 2, 3], [4, 5, 6]], "space": "IJK"}', "neither LPS nor RAS"),
    "no markups": ("a.mrk.json", json.dumps({"markups": []}), "0 markups"),
    "two markups": ("a.mrk.json", json.dumps({"markups": markups(POINTS)["markups"] * 2}), "2 markups"),
    "markups in metres": ("a.mrk.json", json.dumps(markups(POINTS, coordinateUnits="m")), "not mm"),
    "markups without points": ("a.mrk.json", json.dumps({"markups": [{"type": "Curve"}]}), "controlPoints"),
    "FCSV in an unknown frame": ("a.fcsv", FCSV.format("2") + "a,1,2,3\n", "neither"),
    "short row of FCSV": ("a.fcsv", FCSV.format("LPS") + "a,1,2,3\nb,4,5\n", "line 5"),
}


@pytest.mark.parametrize(("name", "text", "says"), FAULTY_FILES.values(), ids=FAULTY_FILES)
def test_file_that_holds_no_points_is_refused_with_the_place_of_its_fault(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    with pytest.raises(RefusedInputError, match=says):
        read_curve_points(tmp_path / name)


def test_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00")

    with refused(RefusedInputError, "text"):
        read_curve_points(tmp_path / "bytes.txt")


def test_folder_of_points_is_refused(tmp_path):
    with refused(RefusedInputError, "cannot", "read"):
        read_curve_points(tmp_path)


def test_absent_file_of_points_is_refused(tmp_path):
    with refused(UsageError, "file", "absent.txt"):
        read_curve_points(tmp_path / "absent.txt")
