"""The gates ``hu_scale`` and ``stored_sign``: air, soft tissue and the sign, told from the voxels alone."""

from __future__ import annotations

import re

import numpy as np
import pytest
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
from clrecon.reading.common.plausibility import examine_voxels
from clrecon.reading.common.source_facts import PixelFacts

NAMES = ("hu_scale", "stored_sign")


def judge(hu, known=True, disc=None):
    """The gate of the scale of some HU, as they are; `disc` was around a round field of view."""
    hu = np.asarray(hu, np.float32)
    facts = PixelFacts(0.0, float(hu.min()), float(hu.max()), disc=disc)
    return examine_voxels(hu, facts, (), known=known).gates[0]


def gates_of(report):
    return {gate["name"]: gate for gate in report["gates"] if gate["name"] in NAMES}


# --- scale ---
@pytest.mark.parametrize(("tissue", "told"), [(0.09, False), (0.11, True)])
def test_a_missing_intercept_is_told_from_a_tenth_of_soft_tissue_on(tissue, told):
    """Stored values, not known to be HU: air at 24 and soft tissue at 1064."""
    count = 40_000
    stored = np.where(np.arange(count) < tissue * count, 1064.0, 24.0).reshape(4, 100, 100)
    gate = judge(stored + np.random.default_rng(3).normal(0, 8, stored.shape), known=False)
    assert gate.ok is (False if told else None) and ("intercept seems to be missing" in gate.text) == told


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
def test_both_peaks_in_wrong_places_fail(slope, offset, air, tissue, reason, noise):
    gate = judge(make_body(noise) * slope + offset)
    assert (gate.ok, gate.measured, gate.bound) == (False, 2, 0)
    found = [int(word) for word in gate.text.split() if word.lstrip("-").isdigit()][:2]
    assert found == pytest.approx([air, tissue], abs=12 * max(slope, 1.0))
    assert re.sub(r"\d+ HU", "N HU", reason) in re.sub(r"\d+ HU", "N HU", gate.text)


@pytest.mark.parametrize(("slope", "offset", "alone"), [(0.8, 140, True), (0.8, 750, True), (0.5, 0, False)])
def test_a_disc_filled_far_above_the_lowest_peak_tells_air_among_other_materials(slope, offset, alone):
    """`alone`: the verdict without the disc."""
    hu = make_body() * slope + offset
    gate = judge(hu, disc=offset)
    found = [int(word) for word in gate.text.split() if word.lstrip("-").isdigit()][:2]
    assert gate.ok is False and found == pytest.approx([offset - 1000 * slope, offset + 50 * slope], abs=12)
    assert judge(hu).ok is alone and judge(make_body(), disc=0).ok


@pytest.mark.parametrize("shift", [-100, -60, 60, 100])
def test_scanners_that_are_off_by_a_little_are_kept(shift):
    assert judge(make_body() + shift).ok


def foam(hu):
    return np.where(hu < -500, hu + 70, hu)


def with_texture(hu, low, high, spread=60.0):
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
    "lungs": with_texture(make_layers(-850, (6, 50)), -1000, -500),
    "stiff lungs with contrast": with_texture(make_layers(-700, (20, 350), (10, 60)), -1000, -300),
    "lungs of a mouse": with_texture(make_layers(-520, (20, 40), (8, 500)), -1000, -300),
    "lungs and contrast alone": with_texture(make_layers(-800, (20, 330)), -1000, -300),
    "brain and skull": with_texture(make_layers(900, (44, 1400), (42, 36)), 300, 2000, 250),
    "contrast": make_layers(-1000, (40, -100), (35, 60), (20, 400), (6, 1000)),
    "40 keV": make_layers(-1000, (40, -200), (35, 75), (16, 1100), (6, 2600)),
    "metal": make_layers(-1000, (40, -100), (35, 50), (10, 3071)),
    "wood around bone": make_layers(-550, (40, -1000), (20, 900)),
    "loud": make_body(90.0),
}
UNUSUAL["cropped body"] = make_body()[:, 20:76, 20:76]
UNUSUAL["masked to bone"] = np.where(make_body() > 150, make_body(), 0)
UNUSUAL["padded in silence"] = np.where(radius_from() > 46, -2000, make_body())
UNUSUAL["specimen, padded in silence"] = np.where(radius_from() > 46, -2000, UNUSUAL["specimen"])


@pytest.mark.parametrize("name", UNUSUAL)
def test_scans_that_are_merely_unusual_are_kept(name):
    assert judge(UNUSUAL[name]).ok is not False


@pytest.mark.parametrize(
    "raw",
    [
        make_layers(8000, (40, 21000), (30, 30000), noise=900),
        make_layers(60, (40, 130), (30, 220), noise=6),
        make_layers(-600, (40, 400), (30, 1200), noise=20),
    ],
    ids=["16 bits", "8 bits", "with negative noise"],
)
def test_raw_values_are_not_judged(raw):
    gate = judge(raw, known=False)
    assert gate.ok is None and "not known to be HU" in gate.text


def test_raw_values_that_are_called_hu_are_judged_by_what_lies_around_the_densest():
    assert judge(make_layers(8000, (40, 30000), (30, 21000), noise=900)).ok is None
    assert judge(make_layers(8000, (40, 21000), (30, 30000), noise=900)).ok is False


def make_limb(radius=13, tissue=60.0, bone=1300.0, background=-1000.0):
    """A finger: soft tissue fills less than a tenth of the picture."""
    return make_layers(background, (radius, tissue), (6, bone))


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
def test_a_small_body_on_another_scale_is_told_by_the_tissue_around_its_bone(slope, offset, reason):
    hu = make_limb()
    assert np.mean(hu > -300) < 0.07 and judge(hu).ok
    gate = judge(hu * slope + offset)
    assert gate.ok is False
    found = [int(word) for word in gate.text.split() if word.lstrip("-").isdigit()][:2]
    assert found == pytest.approx([offset - 1000 * slope, offset + 60 * slope], abs=15 * max(slope, 1))
    assert re.sub(r"\d+ HU", "N HU", reason) in re.sub(r"\d+ HU", "N HU", gate.text)


@pytest.mark.parametrize(("radius", "noise"), [(30, 150.0), (61.5, 12.0)], ids=["wide peaks", "little air"])
def test_a_body_of_wide_peaks_or_in_little_air_is_told_on_another_scale(radius, noise):
    hu = make_layers(-1000.0, (radius, 60.0), (9, 1300.0), noise=noise) * 0.6 + 150.0
    gate = judge(hu)
    assert gate.ok is False and "air lies near -4" in gate.text and re.search("soft tissue near 1[789]", gate.text)


def test_a_missing_intercept_of_a_small_body_is_told_where_no_header_says_hu():
    assert judge(make_limb() + 1024, known=False).ok is False


def test_bone_in_water_is_no_body_without_its_intercept():
    """Water at 24 and cortex near 1064 with denser noise; of a body, soft tissue lies around what is denser."""
    cortex = make_layers(24, (13, 1064), (6, 24), noise=120)
    dense = make_layers(24, (13, 1900), (10, 1064), noise=30)
    assert judge(cortex).ok and judge(dense).ok
    assert judge(make_limb() + 1024).ok is False


@pytest.mark.parametrize(
    "make",
    [make_body, lambda: make_layers(-1000.0, (22, 60.0), (16, 1300.0))],
    ids=["trunk", "limb that is mostly bone"],
)
def test_a_stated_slope_tells_a_stretched_body_from_a_specimen(tmp_path, make):
    """The same numbers: with slope 1 they may be a dry bone."""
    hu = np.maximum(make(), -1024)
    stretched = read_volume(write_values(tmp_path / "2", hu, RescaleSlope=2)).report
    assert gates_of(stretched)["hu_scale"]["ok"] is False
    plain = write_values(tmp_path / "1", 2 * (hu + 1024) - 1024)
    assert gates_of(read_volume(plain).report)["hu_scale"]["ok"]


def test_scale_is_not_judged_without_air_and_soft_tissue():
    gate = judge(make_layers(600, (30, 900), noise=40))
    assert (gate.ok, gate.measured) == (None, None) and gate.text.endswith("neither was found")


def test_a_small_volume_has_no_peaks():
    assert judge(make_body()[:2, :20, :20] + 324).text.endswith("too few voxels")


# --- sign ---
SIGNS = {
    "16 bits": (write_signed_as_unsigned(16), 0, "65,536 apart, the whole range of 16 stored bits"),
    "12 bits": (write_signed_as_unsigned(12), 0, "4,096 apart, the whole range of 12 stored bits"),
    "JPEG 2000": (write_signed_codestream, 0, "65,536 apart, the whole range of 16 stored bits"),
    "over the sign bit": (write_unsigned_as_signed, 1, "4,096 apart, the whole range of 12 stored bits"),
}


@pytest.mark.parametrize("name", SIGNS)
def test_a_lost_sign_fails_and_nothing_is_repaired(tmp_path, name):
    write, wrong, words = SIGNS[name]
    volume = read_volume(write(tmp_path, make_body()))
    found = gates_of(volume.report)
    assert found["stored_sign"]["ok"] is False and found["stored_sign"]["measured"] >= 50
    text = found["stored_sign"]["text"]
    assert words in text and f"PixelRepresentation is {wrong}" in text
    assert f"write the files anew with PixelRepresentation {1 - wrong}" in text
    assert text in volume.report["warnings"] and not any("saturated" in one for one in volume.report["warnings"])
    assert found["hu_scale"]["ok"] is None
    assert gates_of(list_series(tmp_path, pixels=True).certificate) == found
    off = volume.voxels - make_body()
    assert set(np.unique(off)) == {0, -4096 if wrong else 1 << (12 if "12" in name else 16)}


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
def test_a_sign_that_is_right_is_kept(tmp_path, hu, plan):
    assert gates_of(read_volume(write_values(tmp_path, hu, plan)).report)["stored_sign"]["ok"]


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nrrd"])
def test_grid_file_that_lost_its_sign_fails_the_gate_of_signs(tmp_path, name):
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
    volume = read_volume(path)
    assert gates_of(volume.report)["stored_sign"]["ok"] is False
    assert gates_of(volume.report)["stored_sign"]["text"] in volume.report["warnings"]


def test_grid_file_on_another_scale_fails_the_gate_of_hu(tmp_path):
    path = tmp_path / "a.nii.gz"
    Volume((make_body() + 324).astype(np.int16), np.diag([1.0, 1.0, 2.0, 1.0])).save(path)
    report = read_volume(path).report
    assert gates_of(report)["hu_scale"]["ok"] is False and gates_of(report)["stored_sign"]["ok"]
    assert gates_of(report)["hu_scale"]["text"] in report["warnings"]
    assert gates_of(list_series(path, pixels=True).certificate) == gates_of(report)


@pytest.mark.parametrize("outside", [0.0, -1024.0], ids=["as the scanner wrote it", "as it was exported"])
def test_a_cone_beam_in_a_grid_file_is_on_its_own_scale_whatever_fills_the_outside(tmp_path, outside):
    path = tmp_path / "a.nii.gz"
    Volume(make_jaw(0.8, 360.0, outside).astype(np.int16), np.diag([1.0, 1.0, 2.0, 1.0])).save(path)
    report = read_volume(path).report
    assert "air lies near -4" in gates_of(report)["hu_scale"]["text"]
    assert (report["padding_share"] > 0.2) == (outside == 0.0)


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
def test_real_scans_keep_both(real_data, folder):
    found = gates_of(read_volume(real_data / folder).report)
    assert [found[name]["ok"] is not False for name in NAMES] == [True, True]
