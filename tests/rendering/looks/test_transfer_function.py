"""Transfer functions: exact between points and at steps, read-only, and refused with the point that is wrong."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from refusals import refused
from tolerances import FLOAT64_SHARE, STEP_SIDE

from clrecon.errors import UsageError
from clrecon.rendering import UNSHADED, Lighting, TransferFunction

pytestmark = pytest.mark.unit

STEPPED = [(0, 0, 0, 0, 0), (100, 1, 1, 1, 0.2), (100, 1, 0, 0, 0.6), (300, 1, 1, 0.5, 1)]
"""Points (HU, red, green, blue, opacity) with a step at 100 HU."""


def test_transfer_function_is_linear_between_points_and_constant_beyond() -> None:
    function = TransferFunction([(-100, 0.2, 0, 1, 0.1), (300, 0.6, 1, 0, 0.9)])
    found = function([-5000, -100, 0, 100, 300, 5000])
    want = [[0.2, 0, 1, 0.1]] * 2 + [[0.3, 0.25, 0.75, 0.3], [0.4, 0.5, 0.5, 0.5]] + [[0.6, 1, 0, 0.9]] * 2
    np.testing.assert_allclose(found, want, atol=FLOAT64_SHARE)
    assert function(np.zeros((3, 2))).shape == (3, 2, 4)


def test_step_of_a_transfer_function_has_its_second_point_from_its_hu_on() -> None:
    function = TransferFunction(STEPPED)
    assert function([np.nextafter(100, -1), 100.0])[:, 3] == pytest.approx([0.2, 0.6], abs=FLOAT64_SHARE)
    assert function([100.0]).tolist() == [[1, 0, 0, 0.6]]


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.75, 0.25)], ids=["up", "down"])
def test_step_alone_has_its_second_value_from_its_hu_on(low: float, high: float) -> None:
    threshold = TransferFunction([(200, 1, 1, 1, low), (200, 1, 1, 1, high)])
    assert threshold([-1e5, 199.999, 200, 1e5])[:, 3].tolist() == [low, low, high, high]
    assert threshold.range_hu == (199, 201)


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.75, 0.25)], ids=["up", "down"])
def test_step_at_the_first_point_has_its_second_value_from_its_hu_on(low: float, high: float) -> None:
    function = TransferFunction([(200, 1, 1, 1, low), (200, 1, 1, 1, high), (300, 1, 1, 1, high)])
    assert function([199.9, 200, 400])[:, 3].tolist() == [low, high, high]
    assert function.range_hu == (199, 300)


def test_transfer_function_of_one_point_is_constant() -> None:
    function = TransferFunction([(40, 0.1, 0.2, 0.3, 0.4)])
    assert function([-1000, 40, 3000]).tolist() == [[0.1, 0.2, 0.3, 0.4]] * 3
    assert function.range_hu == (39, 41)


def test_table_of_a_transfer_function_has_its_values_at_evenly_spaced_hu() -> None:
    function = TransferFunction(STEPPED)

    table = function.table(low=-100, high=300, nodes=5)

    assert (table.dtype, table.shape) == (np.float32, (5, 4))
    np.testing.assert_array_equal(table, function([-100, 0, 100, 200, 300]).astype(np.float32))


def test_nodes_of_a_table_beside_a_step_do_not_mix_its_sides() -> None:
    below, above = TransferFunction(STEPPED).table(low=99.5, high=100.5, nodes=2)[:, 3]
    assert below == pytest.approx(0.2 * 99.5 / 100, abs=STEP_SIDE)
    assert above == pytest.approx(0.6 + 0.4 * 0.5 / 200, abs=STEP_SIDE)


def test_table_of_a_step_alone_changes_in_its_middle() -> None:
    step = TransferFunction([(200, 1, 1, 1, 0.0), (200, 1, 1, 1, 1.0)])

    opacity = step.table(*step.range_hu, nodes=4096)[:, 3]

    assert opacity[:2048].max() == 0
    assert opacity[2048:].min() == 1


@pytest.mark.parametrize(("low", "high", "nodes"), [(0, 1, 1), (1, 0, 4), (0, np.inf, 4), (np.nan, 1, 4)])
def test_table_of_fewer_than_two_nodes_or_no_range_is_refused(low: float, high: float, nodes: int) -> None:
    with refused(UsageError, "two", "nodes", "lower", "higher"):
        TransferFunction(STEPPED).table(low, high, nodes)


def test_gradient_opacity_is_linear_between_its_points_with_a_step() -> None:
    function = TransferFunction(STEPPED, gradient_opacity=[(10, 0), (50, 1), (50, 0.5)])  # HU per mm, factor
    assert function.gradient_factor([0, 10, 30, 50, 1000]).tolist() == [0, 0, 0.5, 0.5, 0.5]
    assert function.gradient_table(high=60, nodes=3).tolist() == [0, 0.5, 0.5]  # at 0, 30 and 60


def test_gradient_factor_is_1_without_a_gradient_opacity() -> None:
    function = TransferFunction(STEPPED)
    assert function.gradient_opacity is None
    assert function.gradient_factor([0, 7]).tolist() == [1, 1]


def test_transfer_function_copies_its_points() -> None:
    points = np.array(STEPPED, dtype=np.float64)
    gradient = np.array([(0, 0), (5, 1.0)])
    function = TransferFunction(points, gradient_opacity=gradient)

    points[:] = gradient[:] = 0.5

    assert np.array_equal(function.points, STEPPED)
    assert np.array_equal(function.gradient_opacity, [(0, 0), (5, 1)])


@pytest.mark.parametrize("name", ["points", "gradient_opacity"])
def test_points_of_a_transfer_function_cannot_be_changed(name: str) -> None:
    function = TransferFunction(STEPPED, gradient_opacity=[(0, 0), (5, 1.0)])
    with refused(ValueError, "read-only"):
        getattr(function, name)[0, 0] = 3


@pytest.mark.parametrize("name", ["points", "unit_distance", "gradient_opacity", "lighting", "name"])
def test_attribute_of_a_transfer_function_cannot_be_set(name: str) -> None:
    with refused(AttributeError, name):
        setattr(TransferFunction(STEPPED), name, None)


@pytest.fixture
def named_function() -> TransferFunction:
    """The points of `STEPPED` with every other field."""
    return TransferFunction(STEPPED, unit_distance=2, gradient_opacity=[(0, 1), (5, 0)], name="x", lighting=UNSHADED)


def test_scaled_transfer_function_has_its_opacities_times_the_factor_up_to_1(named_function: TransferFunction) -> None:
    assert named_function.scaled(opacity=2).points[:, 4].tolist() == [0, 0.4, 1, 1]


def test_shifted_transfer_function_has_its_points_at_other_hu(named_function: TransferFunction) -> None:
    shifted = named_function.shifted(-50)
    assert shifted.points[:, 0].tolist() == [-50, 50, 50, 250]
    np.testing.assert_array_equal(shifted([0.0, 50]), named_function([50.0, 100]))


@pytest.mark.parametrize("change", [lambda f: f.scaled(opacity=2), lambda f: f.shifted(-50)], ids=["scaled", "shifted"])
def test_scaled_or_shifted_transfer_function_keeps_distance_name_light_and_gradient(
    change: Any, named_function: TransferFunction
) -> None:
    changed = change(named_function)
    assert (changed.unit_distance, changed.name, changed.lighting) == (2, "x", UNSHADED)
    assert np.array_equal(changed.gradient_opacity, [(0, 1), (5, 0)])


@pytest.mark.parametrize("factor", [-1, np.nan, np.inf])
def test_factor_of_opacities_below_0_or_not_finite_is_refused(factor: float, named_function: TransferFunction) -> None:
    with refused(UsageError, "factor", "opacities"):
        named_function.scaled(factor)


def test_shift_beyond_a_million_hu_is_refused(named_function: TransferFunction) -> None:
    with refused(UsageError, "million"):
        named_function.shifted(1e7)


@pytest.mark.parametrize(
    ("ends", "greys"), [((-100, 300), [0, 0.25, 1]), ((300, -100), [1, 0.75, 0])], ids=["rising", "falling"]
)
def test_window_is_a_ramp_of_grey_and_opacity_between_its_ends(ends: tuple[float, float], greys: list[float]) -> None:
    function = TransferFunction.from_window(*ends)
    below, a_quarter_in, above = -200, 0, 400
    assert function([below, a_quarter_in, above]).tolist() == [[grey] * 4 for grey in greys]


def test_window_without_a_width_is_refused() -> None:
    with refused(UsageError, "HU", 5):
        TransferFunction.from_window(low=5, high=5)


def test_transfer_functions_with_the_same_points_are_equal_whatever_their_names() -> None:
    function, same = TransferFunction(STEPPED, name="a"), TransferFunction(np.array(STEPPED), name="b")
    assert function == same
    assert hash(function) == hash(same)


@pytest.mark.parametrize(
    "change",
    [{"unit_distance": 2}, {"gradient_opacity": [(0, 1), (9, 0.5)]}, {"lighting": Lighting()}],
    ids=["unit distance", "gradient opacity", "lighting"],
)
def test_transfer_functions_that_differ_in_what_is_drawn_are_not_equal(change: dict[str, Any]) -> None:
    function = TransferFunction(STEPPED)
    assert function != function.changed(**change)


def test_transfer_function_is_not_equal_to_a_shifted_one_nor_to_a_name() -> None:
    function = TransferFunction(STEPPED)
    assert function != function.shifted(1)
    assert function != "bone"


def test_copied_and_pickled_transfer_functions_are_equal_to_the_first() -> None:
    function = TransferFunction(STEPPED, name="a")
    assert copy.deepcopy(function) == function
    assert pickle.loads(pickle.dumps(function)) == function


def test_transfer_function_is_described_by_name_points_and_range() -> None:
    assert repr(TransferFunction(STEPPED, name="a")) == "TransferFunction('a', 4 points from 0 to 300 HU)"


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
def test_points_of_a_wrong_form_are_refused_with_the_point_and_what_is_wrong(points: object, message: str) -> None:
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
def test_parameter_of_a_transfer_function_out_of_range_is_refused(parameters: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TransferFunction(STEPPED, **parameters)


@pytest.mark.parametrize(
    ("given", "unit"), [((0, -3, 4), (0, -0.6, 0.8)), ((0, 0, 1e300), (0, 0, 1))], ids=["of length 5", "very long"]
)
def test_direction_of_a_light_is_made_a_unit_vector(given: tuple, unit: tuple) -> None:
    assert Lighting(direction=given).direction == pytest.approx(unit, abs=FLOAT64_SHARE)


def test_light_by_default_has_no_direction_of_its_own_and_shades() -> None:
    assert Lighting().direction is None
    assert Lighting().shades


@pytest.mark.parametrize(
    ("light", "shades"),
    [(Lighting(ambient=1, diffuse=0, specular=0.1), True), (UNSHADED, False)],
    ids=["highlights alone", "none"],
)
def test_light_shades_where_it_has_a_diffuse_or_specular_part(light: Lighting, shades: bool) -> None:
    assert light.shades == shades


def test_lights_of_the_same_parameters_have_one_hash() -> None:
    assert hash(Lighting()) == hash(Lighting(ambient=0.2))  # the default


@pytest.mark.parametrize(
    ("parameters", "facts"),
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
def test_impossible_parameter_of_lighting_is_refused(parameters: dict, facts: tuple) -> None:
    with refused(UsageError, *facts):
        Lighting(**parameters)
