"""Files of measures: tables, JSON and markups of 3D Slicer, with names, values and frames."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.rendering.views.centre_line import read_curve_points
from clrecon.viewer.model.measures import Measure, encode_measures, measure_points
from clrecon.viewer.model.regions import measure_region

pytestmark = pytest.mark.unit

MEASURES = (
    measure_points("distance", [(1.0, 2.0, 3.0), (4.0, 6.0, 15.0)], name='L3, "height"'),
    measure_points("angle", [(1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)], name="Winkel für T12"),
    measure_points("seed", [(1.5, -2.25, 0.0)], name="place 1"),
)


def test_csv_of_measures_has_a_row_for_each_with_value_unit_and_points() -> None:
    text = encode_measures(MEASURES, "a.csv", "lps").decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["name"] for row in rows] == ['L3, "height"', "Winkel für T12", "place 1"]
    assert [(row["value"], row["unit"]) for row in rows] == [("13.0", "mm"), ("90.0", "degrees"), ("", "")]
    assert rows[0]["points_mm"] == "1.000 2.000 3.000; 4.000 6.000 15.000"


def test_json_of_measures_names_its_frame_and_has_its_points_in_it() -> None:
    content = json.loads(encode_measures(MEASURES, "A.JSON", "ras"))
    assert (content["space"], content["points_unit"]) == ("RAS", "mm")
    _, _, seed = content["measures"]
    assert seed == {
        "name": "place 1", "kind": "seed", "points": [[-1.5, 2.25, 0.0]], "value": None, "unit": "",
    }  # fmt: skip


def test_markups_of_measures_have_their_types_names_and_points_in_lps_whatever_the_frame() -> None:
    content = json.loads(encode_measures(MEASURES, "a.mrk.json", "ras"))
    assert content["@schema"].endswith("markups-schema-v1.0.3.json#")
    markups = content["markups"]
    assert [(each["type"], each["coordinateSystem"]) for each in markups] == [
        ("Line", "LPS"), ("Angle", "LPS"), ("Fiducial", "LPS"),
    ]  # fmt: skip
    line, _, seed = markups
    assert line["name"] == 'L3, "height"'
    assert [each["position"] for each in line["controlPoints"]] == [[1.0, 2.0, 3.0], [4.0, 6.0, 15.0]]
    assert [each["label"] for each in seed["controlPoints"]] == ["place 1"]


def test_markups_of_one_curve_are_read_as_a_centre_line(tmp_path) -> None:
    points = [(0.0, 0.0, 0.0), (0.0, 1.0, 10.0), (0.0, 0.0, 20.0)]
    path = tmp_path / "curve.mrk.json"
    path.write_bytes(encode_measures([measure_points("curve", points, name="canal")], path.name, "lps"))
    assert read_curve_points(path).tolist() == [list(point) for point in points]


def measured_circle() -> Measure:
    """A circle of 5 mm in a scan of 100 HU in one half and 200 HU in the other, on a grid of 1 mm."""
    hu = np.full((3, 21, 21), 100, np.int16)
    hu[:, :, 11:] = 200
    middle, right, below = (10.5, 10.0, 1.0), (15.5, 10.0, 1.0), (10.5, 15.0, 1.0)
    return measure_region(Volume(hu, np.eye(4)), "circle", [middle, right, below], name="L2")


def test_csv_of_a_circle_has_its_deviation_voxels_and_area() -> None:
    (row,) = csv.DictReader(io.StringIO(encode_measures([measured_circle()], "a.csv", "lps").decode()))

    assert (row["value"], row["unit"]) == ("150.0", "HU")
    assert row["voxels"] == "78"  # centres within 5 mm of a place between two of them
    assert float(row["sd"]) == pytest.approx(50.0 * (78 / 77) ** 0.5, abs=1e-3)  # two equal halves, written to 0.001
    assert float(row["area_mm2"]) == pytest.approx(78.54, abs=0.01)  # 25 pi


def test_markups_of_a_circle_are_a_closed_curve_of_points_at_its_radius() -> None:
    content = json.loads(encode_measures([measured_circle()], "a.mrk.json", "lps"))

    (markup,) = content["markups"]
    points = np.array([each["position"] for each in markup["controlPoints"]])
    assert markup["type"] == "ClosedCurve"
    assert np.linalg.norm(points - (10.5, 10.0, 1.0), axis=1) == pytest.approx(5.0, abs=1e-3)  # as it is rounded
    assert len(np.unique(points, axis=0)) == len(points) == 48  # the places of each outline
