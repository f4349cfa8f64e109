"""Transfer functions: exact between points and at steps, read-only, and refused with the point that is wrong."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from refusals import refused
from tolerances import FLOAT64_SHARE, STEP_SIDE

from clrecon.errors import UsageError
from clrecon.rendering import UNSHADED, Lighting, TransferFunction

pytestmark = pytest.mark.unit

STEPPED = [(0, 0, 0, 0, 0), (100, 1, 1, 1, 0.2), (100, 1, 0, 0, 0.6), (300, 1, 1, 0.5, 1)]


def test_transfer_function_is_linear_between_points_and_constant_beyond() -> None:
    function = TransferFunction([(-100, 0.2, 0, 1, 0.1), (300, 0.6, 1, 0, 0.9)])
    found = function([-5000, -100, 0, 100, 300, 5000])
    want = [[0.2, 0, 1, 0.1]] * 2 + [[0.3, 0.25, 0.75, 0.3], [0.4, 0.5, 0.5, 0.5]] + [[0.6, 1, 0, 0.9]] * 2
    np.testing.assert_allclose(found, want, atol=FLOAT64_SHARE)
    assert function(np.zeros((3, 2))).shape == (3, 2, 4)


def test_a_step_has_its_second_point_from_its_hu_on() -> None:
    function = TransferFunction(STEPPED)
    assert function([np.nextafter(100, -1), 100.0])[:, 3] == pytest.approx([0.2, 0.6], abs=FLOAT64_SHARE)
    assert function([100.0]).tolist() == [[1, 0, 0, 0.6]]


@pytest.mark.parametrize("opacities", [(0.0, 1.0), (0.75, 0.25)])
def test_steps_at_the_ends_have_their_second_value_from_their_hu_on(opacities: tuple[float, float]) -> None:
    low, high = opacities
    threshold = TransferFunction([(200, 1, 1, 1, low), (200, 1, 1, 1, high)])
    assert threshold([-1e5, 199.999, 200, 1e5])[:, 3].tolist() == [low, low, high, high]
    assert threshold.range_hu == (199, 201)
    first = TransferFunction([(200, 1, 1, 1, low), (200, 1, 1, 1, high), (300, 1, 1, 1, high)])
    assert first([199.9, 200, 400])[:, 3].tolist() == [low, high, high]
    assert first.range_hu == (199, 300)


def test_one_point_is_a_constant() -> None:
    function = TransferFunction([(40, 0.1, 0.2, 0.3, 0.4)])
    assert function([-1000, 40, 3000]).tolist() == [[0.1, 0.2, 0.3, 0.4]] * 3
    assert function.range_hu == (39, 41)


def test_the_table_holds_its_ends_and_what_lies_evenly_between() -> None:
    function = TransferFunction(STEPPED)
    table = function.table(-100, 300, 5)
    assert (table.dtype, table.shape) == (np.float32, (5, 4))
    np.testing.assert_array_equal(table, function([-100, 0, 100, 200, 300]).astype(np.float32))
    # A step between two nodes: neither of them mixes its sides.
    assert function.table(99.5, 100.5, 2)[:, 3].tolist() == pytest.approx([0.199, 0.601], abs=STEP_SIDE)
    ends = TransferFunction([(200, 1, 1, 1, 0.0), (200, 1, 1, 1, 1.0)])
    assert ends.table(*ends.range_hu, 4096)[[0, 2047, 2048, 4095], 3].tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize("table", [(0, 1, 1), (1, 0, 4), (0, np.inf, 4), (np.nan, 1, 4)])
def test_a_table_of_nothing_is_refused(table: tuple[float, float, int]) -> None:
    with pytest.raises(UsageError, match="two nodes or more from a lower to a higher value"):
        TransferFunction(STEPPED).table(*table)


def test_gradient_opacity_is_linear_with_steps() -> None:
    function = TransferFunction(STEPPED, gradient_opacity=[(10, 0), (50, 1), (50, 0.5)])
    assert function.gradient_factor([0, 10, 30, 50, 1000]).tolist() == [0, 0, 0.5, 0.5, 0.5]
    assert function.gradient_table(60, 3).tolist() == [0, 0.5, 0.5]
    assert TransferFunction(STEPPED).gradient_factor([0, 7]).tolist() == [1, 1]
    assert TransferFunction(STEPPED).gradient_opacity is None


def test_transfer_function_cannot_be_changed_and_copies_its_input() -> None:
    points = np.array(STEPPED, dtype=np.float64)
    gradient = np.array([(0, 0), (5, 1.0)])
    function = TransferFunction(points, gradient_opacity=gradient)
    points[:] = 0.5
    gradient[:] = 0.5
    assert function.points.tolist() == [[float(number) for number in row] for row in STEPPED]
    for array in (function.points, function.gradient_opacity):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 3
    for name in ("points", "unit_distance", "gradient_opacity", "lighting", "name"):
        with pytest.raises(AttributeError, match=name):
            setattr(function, name, None)


def test_transfer_function_is_scaled_and_shifted() -> None:
    function = TransferFunction(
        STEPPED, unit_distance=2, gradient_opacity=[(0, 1), (5, 0)], name="x", lighting=UNSHADED
    )
    double = function.scaled(opacity=2)
    assert double.points[:, 4].tolist() == [0, 0.4, 1, 1]
    moved = function.shifted(-50)
    assert moved.points[:, 0].tolist() == [-50, 50, 50, 250]
    np.testing.assert_array_equal(moved([0.0, 50]), function([50.0, 100]))
    for changed in (double, moved):
        assert (changed.unit_distance, changed.name, changed.lighting) == (2, "x", UNSHADED)
        assert np.array_equal(changed.gradient_opacity, [(0, 1), (5, 0)])
    for factor in (-1, np.nan, np.inf):
        with refused(UsageError, "factor", "opacities"):
            function.scaled(factor)
    with refused(UsageError, "million"):
        function.shifted(1e7)


def test_a_window_is_a_grey_ramp() -> None:
    assert TransferFunction.from_window(-100, 300)([-200, 0, 400]).tolist() == [[0] * 4, [0.25] * 4, [1] * 4]
    assert TransferFunction.from_window(300, -100)([-200, 0, 400]).tolist() == [[1] * 4, [0.75] * 4, [0] * 4]
    with refused(UsageError, "HU", 5):
        TransferFunction.from_window(5, 5)


def test_equal_is_what_gives_the_same_picture() -> None:
    function = TransferFunction(STEPPED, name="a")
    same = TransferFunction(np.array(STEPPED), name="b")
    assert function == same and hash(function) == hash(same)
    others = [
        function.shifted(1),
        function.changed(unit_distance=2),
        function.changed(gradient_opacity=[(0, 1), (9, 0.5)]),
        function.changed(lighting=Lighting()),
    ]
    assert [function == other for other in others] == [False] * 4
    assert function != "bone"
    assert copy.deepcopy(function) == pickle.loads(pickle.dumps(function)) == function
    assert repr(function) == "TransferFunction('a', 4 points from 0 to 300 HU)"


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([], r"\(hu, red, green, blue, opacity\), not of an array of shape \(0,\)"),
        ([1, 2, 3, 4, 5], r"shape \(5,\)"),
        ([(0, 1, 1, 1)], r"shape \(1, 4\)"),
        ([(0, 1, 1, 1, 1), (5, 1)], "each of 5 numbers"),
        ([("bone", 1, 1, 1, 1)], "each of 5 numbers"),
        (None, "not of an array of shape"),
        ([(0, 1, 1, 1, 1), (1, 1, np.nan, 1, 1)], "point 2 of the transfer function: green is nan"),
        ([(np.inf, 1, 1, 1, 1)], "point 1 of the transfer function: hu is inf"),
        ([(0, 1, 1, 1, 1), (9, 1, 1, 1, 1), (8, 1, 1, 1, 1)], "back from 9 HU at point 2 to 8 HU at point 3"),
        ([(0, 1, 1, 1, 1)] + [(9, 1, 1, 1, 1)] * 3, "more than two points at 9 HU, from point 2 on"),
        ([(0, 1, 1, 1, 1), (9, 1, 1, 1, 1.5)], "opacity of point 2 is 1.5"),
        ([(0, -0.1, 1, 1, 1)], "red of point 1 is -0.1, and must lie between 0 and 1$"),
        ([(0, 255, 128, 1, 1)], "red of point 1 is 255, .* divide numbers up to 255 by 255"),
        ([(1e7, 1, 1, 1, 1)], r"point 1 .* 1e\+07 HU, beyond a million"),
    ],
)
def test_points_of_a_wrong_form_are_refused(points: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TransferFunction(points)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"unit_distance": 0}, "length in mm, .*, not 0"),
        ({"unit_distance": -1}, "length in mm, .*, not -1"),
        ({"unit_distance": np.inf}, "length in mm, .*, not inf"),
        ({"unit_distance": "x"}, "length in mm, .*, not 'x'"),
        ({"gradient_opacity": []}, "HU per mm, factor"),
        ({"gradient_opacity": [(0, 1, 1)]}, r"\(HU per mm, factor\), not of an array of shape \(1, 3\)"),
        ({"gradient_opacity": [(0, np.nan)]}, "point 1 of the gradient opacity: factor is nan"),
        ({"gradient_opacity": [(-1, 0)]}, "goes from 0"),
        ({"gradient_opacity": [(5, 0), (4, 1)]}, "back from 5 HU per mm at point 1 to 4 HU per mm at point 2"),
        ({"gradient_opacity": [(5, 0), (6, 2)]}, "factor of the gradient opacity of point 2 is 2"),
        ({"lighting": "bright"}, "a Lighting or None, not 'bright'"),
        ({"name": 3}, "name and description"),
    ],
)
def test_parameters_out_of_range_are_refused(parameters: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TransferFunction(STEPPED, **parameters)


def test_lighting_keeps_a_unit_direction() -> None:
    assert Lighting(direction=(0, -3, 4)).direction == pytest.approx((0, -0.6, 0.8), abs=FLOAT64_SHARE)
    assert Lighting(direction=(0, 0, 1e300)).direction == (0, 0, 1)
    assert Lighting().direction is None
    assert (Lighting().shades, Lighting(1, 0, 0.1).shades, UNSHADED.shades) == (True, True, False)
    assert hash(Lighting()) == hash(Lighting(ambient=0.2))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"ambient": -0.1}, ("ambient", 0, 1, -0.1)),
        ({"diffuse": 1.1}, ("diffuse",)),
        ({"specular": np.nan}, ("specular", "nan")),
        ({"specular": None}, ("specular",)),
        ({"specular_power": 0.5}, ("power", 1, 128)),
        ({"specular_power": 129}, ("power", 1, 128)),
        ({"soft_gradient": -1}, ("gradient", 0, 10_000)),
        ({"direction": (0, 0, 0)}, (0,)),
        ({"direction": (0, np.inf, 0)}, ("LPS",)),
        ({"direction": (0, 1)}, ("LPS",)),
        ({"direction": "up"}, ("LPS",)),
    ],
)
def test_lighting_out_of_range_is_refused(parameters: dict, message: str) -> None:
    with refused(UsageError, *message):
        Lighting(**parameters)
