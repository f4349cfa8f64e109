"""The gates ``hu_scale`` and ``stored_sign``: air, soft tissue and the sign, told from the voxels alone."""

from __future__ import annotations

import re

import numpy as np
import pytest
import tolerances
from dicom_series import Plan
from value_series import (
    SHAPE,
    make_body,
    make_jaw,
    make_layers,
    radius_from,
    write_signed_as_unsigned,
    write_signed_codestream,
    write_unsigned_as_signed,
    write_values,
)

from clrecon import Volume, list_series, read_volume
from clrecon.reading.common.hu_scale import FEWEST_VALUES
from clrecon.reading.common.plausibility import examine_voxels
from clrecon.reading.common.source_facts import PixelFacts

NAMES = ("hu_scale", "stored_sign")


def judge_scale(hu, known=True, disc=None):
    """The gate ``hu_scale`` of values, `known` to be HU; `disc` is what was around a round field of view."""
    hu = np.asarray(hu, np.float32)
    facts = PixelFacts(padding_share=0.0, hu_min=float(hu.min()), hu_max=float(hu.max()), disc=disc)
    (gate,) = (gate for gate in examine_voxels(hu, facts, (), known=known).gates if gate.name == "hu_scale")
    return gate


def peaks_in(gate):
    """HU of air and of soft tissue that the text of a gate names first."""
    return [int(word) for word in gate.text.split() if word.lstrip("-").isdigit()][:2]


def assert_reason(gate, reason):
    """Assert that the gate gives the reason, whatever its number of HU, which noise moves by a few."""
    assert re.sub(r"\d+ HU", "N HU", reason) in re.sub(r"\d+ HU", "N HU", gate.text)


def value_gates_of(report):
    return {gate["name"]: gate for gate in report["gates"] if gate["name"] in NAMES}


# --- scale ---
@pytest.mark.parametrize(
    ("tissue_share", "fails"), [(0.09, False), (0.11, True)], ids=["less than a tenth", "more than a tenth"]
)
def test_missing_intercept_of_values_not_known_to_be_hu_fails_from_a_tenth_of_soft_tissue_on(tissue_share, fails):
    """Stored values: air at 24 and soft tissue at 1064."""
    count = 40_000
    stored = np.where(np.arange(count) < tissue_share * count, 1064.0, 24.0).reshape(4, 100, 100)
    gate = judge_scale(stored + np.random.default_rng(3).normal(0, 8, stored.shape), known=False)
    assert gate.ok is (False if fails else None)
    assert ("intercept seems to be missing" in gate.text) == fails


@pytest.mark.parametrize(
    ("slope", "offset", "air", "tissue", "reason"),
    [
        (1, 324, -676, 374, "the rescale intercept seems to be 324 HU too high"),
        (1, -324, -1324, -274, "the rescale intercept seems to be 324 HU too low"),
        (1, 200, -800, 250, "the rescale intercept seems to be 200 HU too high"),
        (1, 400, -600, 450, "the rescale intercept seems to be 400 HU too high"),
        (1, 800, -200, 850, "the rescale intercept seems to be 800 HU too high"),
        (1, 1280, 280, 1330, "the rescale intercept seems to be 1280 HU too high"),
        (1, 1024, 24, 1065, "the rescale intercept seems to be missing"),
        (1, -1024, -2024, -983, "the rescale intercept seems to have been applied twice"),
        (0.6, 400, -200, 430, "the rescale slope seems to be wrong, or the scanner has a scale of its own"),
        (7, 0, -7000, 350, "the rescale slope seems to be wrong, or the scanner has a scale of its own"),
        (0.5, -512, -1012, -487, "the rescale slope seems to be wrong, or the scanner has a scale of its own"),
    ],
)
@pytest.mark.parametrize("noise", [5.0, 12.0, 30.0])
def test_body_on_another_scale_fails_with_the_hu_of_both_peaks_and_a_reason(slope, offset, air, tissue, reason, noise):
    gate = judge_scale(make_body(noise=noise) * slope + offset)
    assert (gate.ok, gate.measured, gate.bound) == (False, 2, 0)  # two peaks in wrong places
    assert peaks_in(gate) == pytest.approx([air, tissue], abs=tolerances.PEAK_HU * max(slope, 1.0))
    assert_reason(gate, reason)


@pytest.mark.parametrize(
    ("slope", "offset", "passes_alone"),
    [(0.8, 140, True), (0.8, 750, True), (0.5, 0, False)],
    ids=["140", "750", "half"],
)
def test_cone_beam_on_another_scale_fails_by_the_value_around_its_field_of_view(slope, offset, passes_alone):
    """Cone beams fill the outside with 0 on the scale of HU, far above air; without it the first two look like HU."""
    hu = make_body() * slope + offset
    gate = judge_scale(hu, disc=offset)
    assert gate.ok is False
    air, tissue = offset - 1000 * slope, offset + 50 * slope
    assert peaks_in(gate) == pytest.approx([air, tissue], abs=tolerances.PEAK_HU)
    assert judge_scale(hu).ok is passes_alone


def test_body_in_hu_whose_outside_is_filled_with_0_passes():
    assert judge_scale(make_body(), disc=0).ok


@pytest.mark.parametrize("shift", [-100, -60, 60, 100])
def test_scanner_that_is_off_by_up_to_100_hu_passes(shift):
    assert judge_scale(make_body() + shift).ok


def foam(hu):
    """What was air is 70 HU denser."""
    return np.where(hu < -500, hu + 70, hu)


def with_texture(hu, *, low, high, spread=60.0):
    """Lung and bone are no flat materials."""
    rough = np.random.default_rng(9).normal(0.0, spread, hu.shape)
    return np.where((hu > low) & (hu < high), np.rint(hu + rough), hu)


UNUSUAL = {
    "specimen": make_layers(-1000, (40, 700), (30, 1400), (12, 500)),
    "specimen on foam": foam(make_layers(-1000, (40, 900), (30, 1500))),
    "casting": make_layers(-1000, (40, 1300)),
    "aluminium": make_layers(-1000, (40, 2400)),
    "bone in water": make_layers(0, (30, 900), (20, 400), (10, 1500)),
    "bone in alcohol": make_layers(-130, (30, 900), (20, 500), noise=40),
    "water": make_layers(-1000, (40, 120), (38, 0)),
    "crop in bone": make_layers(250, (30, 900), (20, 1500), noise=40),
    "crop in fat": make_layers(-100, (20, 60)),
    "lungs": with_texture(make_layers(-850, (6, 50)), low=-1000, high=-500),
    "stiff lungs with contrast": with_texture(make_layers(-700, (20, 350), (10, 60)), low=-1000, high=-300),
    "lungs of a mouse": with_texture(make_layers(-520, (20, 40), (8, 500)), low=-1000, high=-300),
    "lungs and contrast alone": with_texture(make_layers(-800, (20, 330)), low=-1000, high=-300),
    "brain and skull": with_texture(make_layers(900, (44, 1400), (42, 36)), low=300, high=2000, spread=250),
    "contrast": make_layers(-1000, (40, -100), (35, 60), (20, 400), (6, 1000)),
    "40 keV": make_layers(-1000, (40, -200), (35, 75), (16, 1100), (6, 2600)),
    "metal": make_layers(-1000, (40, -100), (35, 50), (10, 3071)),
    "wood around bone": make_layers(-550, (40, -1000), (20, 900)),
    "loud": make_body(noise=90.0),
}
"""`make_layers`: HU around all, and radius in pixels and HU of each layer from outside to inside."""
UNUSUAL["cropped body"] = make_body()[:, 20:76, 20:76]
UNUSUAL["masked to bone"] = np.where(make_body() > 150, make_body(), 0)
UNUSUAL["padded in silence"] = np.where(radius_from() > 46, -2000, make_body())
UNUSUAL["specimen, padded in silence"] = np.where(radius_from() > 46, -2000, UNUSUAL["specimen"])


@pytest.mark.parametrize("name", UNUSUAL)
def test_scan_that_is_merely_unusual_does_not_fail(name):
    assert judge_scale(UNUSUAL[name]).ok is not False


@pytest.mark.parametrize(
    "raw",
    [
        make_layers(8000, (40, 21000), (30, 30000), noise=900),
        make_layers(60, (40, 130), (30, 220), noise=6),
        make_layers(-600, (40, 400), (30, 1200), noise=20),
    ],
    ids=["16 bits", "8 bits", "with negative noise"],
)
def test_raw_values_not_known_to_be_hu_are_not_judged(raw):
    gate = judge_scale(raw, known=False)
    assert gate.ok is None
    assert "not known to be HU" in gate.text


def test_raw_values_that_are_called_hu_fail_where_softer_layers_lie_around_the_densest():
    densest_inside = make_layers(8000, (40, 21000), (30, 30000), noise=900)  # as bone in tissue in air
    densest_outside = make_layers(8000, (40, 30000), (30, 21000), noise=900)
    assert judge_scale(densest_inside).ok is False
    assert judge_scale(densest_outside).ok is None


def make_limb(radius=13, tissue=60.0, bone=1300.0, background=-1000.0):
    """A finger: soft tissue fills less than a tenth of the picture."""
    return make_layers(background, (radius, tissue), (6, bone))


def test_finger_in_hu_whose_soft_tissue_fills_less_than_a_tenth_passes():
    hu = make_limb()
    assert np.mean(hu > -300) < 0.1  # air is at -1000 HU, tissue at 60
    assert judge_scale(hu).ok


@pytest.mark.parametrize(
    ("slope", "offset", "reason"),
    [
        (1, 1024, "the rescale intercept seems to be missing"),
        (1, 600, "the rescale intercept seems to be 600 HU too high"),
        (1, 500, "the rescale intercept seems to be 500 HU too high"),
        (0.5, 0, "the rescale slope seems to be wrong, or the scanner has a scale of its own"),
        (10, 20000, "the rescale slope seems to be wrong, or the scanner has a scale of its own"),
    ],
)
def test_finger_on_another_scale_fails_by_the_tissue_around_its_bone(slope, offset, reason):
    gate = judge_scale(make_limb(tissue=60.0, background=-1000.0) * slope + offset)
    assert gate.ok is False
    air, tissue = offset - 1000 * slope, offset + 60 * slope
    assert peaks_in(gate) == pytest.approx([air, tissue], abs=tolerances.SMALL_BODY_PEAK_HU * max(slope, 1))
    assert_reason(gate, reason)


@pytest.mark.parametrize(("radius", "noise"), [(30, 150.0), (61.5, 12.0)], ids=["wide peaks", "little air"])
def test_body_on_another_scale_fails_with_much_noise_or_in_little_air(radius, noise):
    gate = judge_scale(make_layers(-1000.0, (radius, 60.0), (9, 1300.0), noise=noise) * 0.6 + 150.0)
    air, tissue = peaks_in(gate)
    assert gate.ok is False
    assert air == pytest.approx(-1000 * 0.6 + 150, abs=tolerances.PEAK_HU)  # of wide peaks measured 6 off
    assert tissue == pytest.approx(60 * 0.6 + 150, abs=tolerances.PEAK_HU)


def test_finger_without_its_intercept_fails_where_no_header_says_hu():
    assert judge_scale(make_limb() + 1024, known=False).ok is False


@pytest.mark.parametrize(
    "hu",
    [make_layers(24, (13, 1064), (6, 24), noise=120), make_layers(24, (13, 1900), (10, 1064), noise=30)],
    ids=["hollow cortex", "dense shell"],
)
def test_bone_in_water_is_not_taken_for_a_finger_without_its_intercept(hu):
    """Water at 24 HU and bone near 1064, where air and tissue of a finger would be: but nothing denser lies inside."""
    assert judge_scale(hu).ok


TRUNK_AND_LIMB = pytest.mark.parametrize(
    "hu",
    [make_body(), np.maximum(make_layers(-1000.0, (22, 60.0), (16, 1300.0)), -1024)],
    ids=["trunk", "limb that is mostly bone"],
)


@TRUNK_AND_LIMB
def test_body_whose_header_has_a_slope_of_2_fails(tmp_path, hu):
    report = read_volume(write_values(tmp_path, hu, RescaleSlope=2)).report
    assert value_gates_of(report)["hu_scale"]["ok"] is False


@TRUNK_AND_LIMB
def test_the_same_numbers_with_a_slope_of_1_pass_as_dry_bone(tmp_path, hu):
    report = read_volume(write_values(tmp_path, 2 * (hu + 1024) - 1024)).report
    assert value_gates_of(report)["hu_scale"]["ok"]


def test_scale_is_not_judged_without_air_and_soft_tissue():
    gate = judge_scale(make_layers(600, (30, 900), noise=40))
    assert (gate.ok, gate.measured) == (None, None)
    assert gate.text.endswith("neither was found")


def test_scale_of_800_voxels_is_not_judged():
    voxels = make_body()[:2, :20, :20] + 324  # as a whole this body fails
    assert voxels.size < FEWEST_VALUES  # 4,000
    gate = judge_scale(voxels)
    assert gate.ok is None
    assert gate.text.endswith("too few voxels")


# --- sign ---
SIGNS = {
    "16 bits": (write_signed_as_unsigned(16), 0, "65,536 apart, the whole range of 16 stored bits"),
    "12 bits": (write_signed_as_unsigned(12), 0, "4,096 apart, the whole range of 12 stored bits"),
    "JPEG 2000": (write_signed_codestream, 0, "65,536 apart, the whole range of 16 stored bits"),
    "over the sign bit": (write_unsigned_as_signed, 1, "4,096 apart, the whole range of 12 stored bits"),
}


@pytest.fixture(params=SIGNS)
def read_without_sign(request, tmp_path):
    """A volume whose sign was lost, its folder, which PixelRepresentation is wrong, and words of the gate."""
    write, wrong, words = SIGNS[request.param]
    folder = write(tmp_path, make_body())
    return read_volume(folder), folder, wrong, words


def test_lost_sign_fails_with_its_range_and_the_right_pixel_representation(read_without_sign):
    volume, _, wrong, words = read_without_sign
    gate = value_gates_of(volume.report)["stored_sign"]
    assert gate["ok"] is False
    assert gate["measured"] >= 50  # pairs of neighbours a whole range apart, the fewest that fail the gate
    assert words in gate["text"]
    assert f"PixelRepresentation is {wrong}" in gate["text"]
    assert f"write the files anew with PixelRepresentation {1 - wrong}" in gate["text"]


def test_lost_sign_is_warned_of_and_not_also_as_saturated_or_on_another_scale(read_without_sign):
    volume, _, _, _ = read_without_sign
    gates = value_gates_of(volume.report)
    assert gates["stored_sign"]["text"] in volume.report["warnings"]
    assert not any("saturated" in warning for warning in volume.report["warnings"])
    assert gates["hu_scale"]["ok"] is None


def test_lost_sign_fails_in_the_listing_too(read_without_sign):
    volume, folder, _, _ = read_without_sign
    assert value_gates_of(list_series(folder, pixels=True).certificate) == value_gates_of(volume.report)


def test_values_that_lost_their_sign_are_not_repaired(read_without_sign):
    volume, _, wrong, words = read_without_sign
    whole_range = 2**16 if "16 stored bits" in words else 2**12
    off = volume.voxels - make_body()
    assert set(np.unique(off)) == {0, -whole_range if wrong else whole_range}


@pytest.mark.parametrize(
    ("hu", "plan"),
    [
        (make_body(), Plan(shape=SHAPE, bits_stored=12, signed=False)),
        (
            (UNUSUAL["metal"] + 400 * (UNUSUAL["metal"] > 2000)).clip(-1024, 3071),
            Plan(shape=SHAPE, bits_stored=12, signed=False),
        ),
        (make_body(), Plan(shape=SHAPE, intercept=0)),
        (make_layers(-1000, (40, 3071), noise=40).clip(-1024, 3071), Plan(shape=SHAPE, bits_stored=12, signed=False)),
        (make_layers(2000, (40, 45000), (30, 58000), noise=900), Plan(shape=SHAPE, intercept=0, signed=False)),
        (np.where(radius_from() < 40, 65535.0, 0.0) * np.ones(SHAPE), Plan(shape=SHAPE, intercept=0, signed=False)),
    ],
    ids=["12 bits", "saturated metal", "signed", "metal in air", "micro-CT", "mask"],
)
def test_scan_whose_sign_is_right_passes(tmp_path, hu, plan):
    assert value_gates_of(read_volume(write_values(tmp_path, hu, plan)).report)["stored_sign"]["ok"]


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nrrd"])
def test_grid_file_that_lost_its_sign_fails_with_a_warning(tmp_path, name):
    """HU that were stored as uint16: 64,536 for air."""
    nibabel = pytest.importorskip("nibabel")
    hu = make_body().astype(np.int16)
    path = tmp_path / name
    if name.endswith("nrrd"):
        header = "NRRD0004\ntype: uint16\ndimension: 3\nsizes: 96 96 8\nspace: left-posterior-superior\n"
        header += "space directions: (1,0,0) (0,1,0) (0,0,2)\nspace origin: (0,0,0)\nencoding: raw\nendian: little\n\n"
        path.write_bytes(header.encode() + hu.tobytes())
    else:
        nibabel.save(nibabel.Nifti1Image(hu.view(np.uint16).T, np.diag([-1, -1, 2, 1])), path)
    report = read_volume(path).report
    gate = value_gates_of(report)["stored_sign"]
    assert gate["ok"] is False
    assert gate["text"] in report["warnings"]


def test_grid_file_on_another_scale_fails_with_a_warning(tmp_path):
    path = tmp_path / "a.nii.gz"
    Volume((make_body() + 324).astype(np.int16), np.diag([1.0, 1.0, 2.0, 1.0])).save(path)
    report = read_volume(path).report
    gates = value_gates_of(report)
    assert (gates["hu_scale"]["ok"], gates["stored_sign"]["ok"]) == (False, True)
    assert gates["hu_scale"]["text"] in report["warnings"]


def test_gates_of_a_grid_file_are_the_same_in_the_listing(tmp_path):
    path = tmp_path / "a.nii.gz"
    Volume((make_body() + 324).astype(np.int16), np.diag([1.0, 1.0, 2.0, 1.0])).save(path)
    assert value_gates_of(list_series(path, pixels=True).certificate) == value_gates_of(read_volume(path).report)


@pytest.mark.parametrize("outside", [0.0, -1024.0], ids=["as the scanner wrote it", "as it was exported"])
def test_cone_beam_in_a_grid_file_fails_on_its_own_scale_whatever_fills_the_outside(tmp_path, outside):
    path = tmp_path / "a.nii.gz"
    Volume(make_jaw(slope=0.8, offset=360.0, padding=outside).astype(np.int16), np.diag([1.0, 1.0, 2.0, 1.0])).save(
        path
    )
    report = read_volume(path).report
    assert "air lies near -4" in value_gates_of(report)["hu_scale"]["text"]  # -1000 * 0.8 + 360 is -440
    assert (report["padding_share"] > 0.2) == (outside == 0.0)  # the corners around a circle of 46 in 48 pixels


@pytest.mark.release
@pytest.mark.parametrize(
    "folder",
    [
        "lumbar_4p25mm",
        "thoracic_0p8mm",
        "head_tilt_gaps",
        "thoracolumbar_labels/ct_2mm_jpeg2000",
        "thoracolumbar_labels/example_ct.nii.gz",
        "thoracolumbar_labels/ct_thorax_1p5mm_cropped.nii.gz",
        "vertebra_masks/sub-verse004_0000_vertebra_21_im.nii.gz",
        "seg_and_labels/ct-3slice",
    ],
)
def test_real_scan_fails_neither_gate_of_its_values(real_data, folder):
    gates = value_gates_of(read_volume(real_data / folder).report)
    assert [gates[name]["ok"] is not False for name in NAMES] == [True, True]
