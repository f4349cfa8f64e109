"""The numbers of docs/geometry.md: taken out of the page, put through the code, and through plain formulas."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from dicom_series import Plan, set_values, write_series

from clrecon import Volume, read_volume
from clrecon.geometry import compose_affine, is_left_handed, normal_matrix, slice_normal, tilt_degrees
from clrecon.geometry.affine import frame_from_lps
from clrecon.geometry.iso_rule import layer_normal_matrices, slice_normal_matrices

PAGE = Path(__file__).resolve().parents[2] / "docs" / "geometry.md"
NAMED = re.compile(r"^    (\w+) = (\(.*\)|\[.*\]|-?[\d.]+)$")
NEXT_ROW = re.compile(r"^ +(\[.*\])$")
NUMBER = re.compile(r"-?\d+(?:\.(\d+))?")


class Printed(NamedTuple):
    """A number or an array of a page, and half a unit of its last digit."""

    values: np.ndarray
    half_a_digit: float


def read_numbers(text: str) -> dict[str, Printed]:
    """The numbers in the indented lines of a page, by name."""
    found: dict[str, list[str]] = {}
    name = ""
    for line in text.splitlines():
        if match := NAMED.match(line):
            name = match[1]
            assert name not in found, f"{name} stands there twice"
            found[name] = [match[2]]
        elif name and (match := NEXT_ROW.match(line)):
            found[name].append(match[1])
        else:
            name = ""
    numbers = {}
    for name, rows in found.items():
        values = [[float(match[0]) for match in NUMBER.finditer(row)] for row in rows]
        decimals = min(len(match[1] or "") for row in rows for match in NUMBER.finditer(row))
        array = np.array(values if len(values) > 1 else values[0])
        numbers[name] = Printed(array[0] if rows[0][0] not in "([" else array, 0.5 * 10.0**-decimals)
    return numbers


@pytest.fixture(scope="module")
def page() -> dict[str, Printed]:
    """The numbers of the worked case on the page."""
    return read_numbers(PAGE.read_text(encoding="utf-8").split("## Worked case")[1])


INPUTS = {"ImageOrientationPatient", "PixelSpacing", "S_0", "S_1", "S_2", "S_3", "S_4", "ijk", "g"}
UNEVEN_INPUTS = {"U_0", "U_1", "U_2", "U_ijk", "c"}


@pytest.fixture(scope="module")
def volume(page, tmp_path_factory) -> Volume:
    """The worked case as a DICOM series with exactly the numbers of the page in its headers, read by clrecon."""
    folder = tmp_path_factory.mktemp("worked")

    def put(ds, k):
        set_values(
            ImageOrientationPatient=page["ImageOrientationPatient"].values.tolist(),
            ImagePositionPatient=page[f"S_{k}"].values.tolist(),
            PixelSpacing=page["PixelSpacing"].values.tolist(),
        )(ds, k)

    write_series(folder, Plan(shape=(5, 4, 6)), put)
    return read_volume(folder)


def compute_page(page, volume: Volume) -> dict[str, np.ndarray]:
    """Everything on the page, as clrecon has it."""
    report, affine = volume.report, volume.affine
    positions = np.array([page[f"S_{k}"].values for k in range(5)])
    normal, step = slice_normal(affine), affine[:3, 2]
    place = volume.ijk_to_lps([page["ijk"].values])
    np.testing.assert_allclose(volume.lps_to_ijk(place), [page["ijk"].values], atol=1e-9)
    gradient = normal_matrix(affine) @ page["g"].values
    turned = affine[:3, :3] @ page["g"].values
    lost = step - (step @ normal) * normal
    i, j, _ = page["ijk"].values
    swap = (affine[:3, 0] / 0.5 * i - affine[:3, 1] / 0.7 * j) * (0.7 - 0.5)
    return {
        "Δi": volume.spacing[0],
        "Δj": volume.spacing[1],
        "n": np.array(report["orientation"]["normal"]),
        "d": positions @ normal,
        "gaps": np.diff(positions @ normal),
        "s": step,
        "origin": affine[:3, 3],
        "residuals": np.linalg.norm(positions - volume.slice_origins(), axis=1),
        "residual_max": report["grid_residual_max_mm"],
        "residual_rms": report["grid_residual_rms_mm"],
        "tolerance": report["grid_tolerance_mm"],
        "along": step @ normal,
        "across": np.linalg.norm(lost),
        "dk": volume.spacing[2],
        "tilt": tilt_degrees(affine),
        "A": affine,
        "determinant": np.linalg.det(affine[:3, :3]),
        "P": place[0],
        "P_ras": frame_from_lps("ras") @ place[0],
        "A_inverse": np.linalg.inv(affine),
        "N": normal_matrix(affine),
        "direction": gradient / np.linalg.norm(gradient),
        "wrong_matrix_degrees": np.degrees(
            np.arccos(gradient @ turned / np.linalg.norm(gradient) / np.linalg.norm(turned))
        ),
        "swapped_mm": np.linalg.norm(swap),
        "lost_tilt_mm": 4 * np.linalg.norm(lost),
    }


def compute_uneven_slices(page) -> dict[str, np.ndarray]:
    in_plane = np.array(page["ImageOrientationPatient"].values).reshape(2, 3)
    dj, di = page["PixelSpacing"].values
    positions = np.array([page[f"U_{k}"].values for k in range(3)])
    steps = (in_plane[0] * di, in_plane[1] * dj)
    nominal = compose_affine(*steps, (positions[2] - positions[0]) / 2, positions[0])
    volume = Volume(np.zeros((3, 4, 6), np.int16), nominal, slice_positions=positions)
    c = page["c"].values
    slopes = [c @ step for step in steps]
    central, within = c @ (positions[2] - positions[0]) / 2, c @ (positions[2] - positions[1])
    found = {
        "U_P": volume.ijk_to_lps([page["U_ijk"].values])[0],
        "g_slice": np.array([*slopes, central]),
        "g_layer": np.array([*slopes, within]),
    }
    np.testing.assert_allclose(slice_normal_matrices(volume, border=0)[1] @ found["g_slice"], c, atol=1e-9)
    np.testing.assert_allclose(layer_normal_matrices(volume, border=0)[1] @ found["g_layer"], c, atol=1e-9)
    return found


@pytest.fixture(scope="module")
def computed(page, volume) -> dict[str, np.ndarray]:
    """The same numbers as clrecon gives them."""
    return compute_page(page, volume) | compute_uneven_slices(page)


def test_the_page_has_the_inputs_and_every_number_that_the_code_gives(page, computed):
    assert set(page) == set(computed) | INPUTS | UNEVEN_INPUTS


def test_every_number_of_the_page_is_what_the_code_gives_to_its_last_digit(page, computed):
    for name, values in computed.items():
        printed, half_a_digit = page[name]
        np.testing.assert_allclose(printed, values, rtol=0, atol=half_a_digit * 1.001, err_msg=name)


def test_the_worked_case_is_right_handed_and_warned_of_with_the_tilt_of_the_page(page, volume):
    assert not is_left_handed(volume.affine)
    assert any(f"gantry tilt -{page['tilt'].values:.2f} degrees" in text for text in volume.report["warnings"])


@pytest.mark.parametrize("k", range(5))
def test_corners_of_each_slice_lie_where_the_standard_puts_them(page, volume, k):
    """PS3.3 C.7.6.2.1.1 with nothing of clrecon in it; what is left is the residual of the fit."""
    cosines, (dj, di) = page["ImageOrientationPatient"].values, page["PixelSpacing"].values
    residual, half_a_digit = page["residual_max"]
    for i, j in ((0, 0), (5, 0), (0, 3), (5, 3)):  # of 6 columns and 4 rows
        expected = page[f"S_{k}"].values + np.array(cosines[:3]) * di * i + np.array(cosines[3:]) * dj * j
        assert np.linalg.norm(volume.ijk_to_lps([(i, j, k)])[0] - expected) <= residual + half_a_digit


def test_indented_numbers_of_a_page_are_read_with_half_a_unit_of_their_last_digit():
    text = "    s = (0.493, -0.655, 0.980)\n    A = [ 1 2 ]\n        [ 3.5 4 ]\n    tilt = 13.5\nno = 3\n"
    numbers = read_numbers(text)
    assert set(numbers) == {"s", "A", "tilt"}
    assert numbers["A"].values.tolist() == [[1, 2], [3.5, 4]]
    assert numbers["A"].half_a_digit == 0.5
    assert numbers["s"].half_a_digit == pytest.approx(0.0005)


def test_a_slice_step_that_is_wrong_in_its_third_digit_is_off_by_more_than_half_a_unit_of_it(computed):
    wrong, half_a_digit = read_numbers("    s = (0.493, -0.655, 0.980)\n")["s"]
    assert np.abs(wrong - computed["s"]).max() > half_a_digit
