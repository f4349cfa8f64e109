"""What is inside of a vertebra: volumes against the phantom's truth, parts that fit together, meshes, refusals."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
from refusals import refused
from variants import daily

import clrecon
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.operators.vertebrae.inside import PARTS, measure_thickness, name_band
from clrecon.proof.phantom import PhantomSettings, make_phantom
from clrecon.proof.phantom.fields import coverage
from clrecon.proof.phantom.settings import CENTRE_LPS_MM
from clrecon.proof.phantom.spine import plan_spine
from clrecon.proof.phantom.vertebra import canal_distance, vertebra_distance

pytestmark = pytest.mark.first_device

SPINE = PhantomSettings(levels="L1-L2", size=(190, 190), spacing=(0.7, 0.7, 1.0))


@pytest.fixture(scope="module")
def spine():
    """A phantom of L1 and L2, and the labels of its truth."""
    voxels, affine, _ = make_phantom(SPINE)
    truth = clrecon.phantom_truth(SPINE)
    return Volume(voxels, affine), LabelMap(truth.label_map(), affine, names=truth.names)


def truth_of(volume, affine, name):
    """Voxels of the cortex, and of the canal without ends, of a level of the phantom."""
    vertebra = next(one for one in plan_spine(SPINE, affine)[0].vertebrae if one.name == name)
    k, j, i = np.indices(volume.voxels.shape).reshape(3, -1)
    local = (volume.ijk_to_lps(np.stack([i, j, k], axis=1)) - CENTRE_LPS_MM - vertebra.center) @ vertebra.axes.T
    bone = vertebra_distance(vertebra, *local.T)
    arch = coverage(local[:, 1] - (vertebra.depth / 2.0 + 1.0), 6.0)
    cortex = (bone >= 0) & (bone < 0.75 + 0.65 * arch)  # as clrecon/proof/phantom/spine.py draws it
    canal = canal_distance(vertebra, local[:, 0], local[:, 1]) >= 0
    return cortex.reshape(volume.voxels.shape), canal.reshape(volume.voxels.shape)


VOXEL_ML = 0.7 * 0.7 * 1.0 / 1000


@pytest.fixture(scope="module")
def inside_at_400(spine, device):
    """L1 of the phantom, its solid grown to 400 HU; its true cortex and canal."""
    volume, labels = spine
    inside = clrecon.vertebra_inside(volume, labels, "L1", iso_value=400, device=device)
    return inside, *truth_of(inside.volume, volume.affine, "L1")


@pytest.mark.seconds
def test_solid_and_dense_volumes_are_those_of_the_phantom_and_what_their_levels_add(spine, inside_at_400):
    """450 HU is not half of the cortex's 850 to 1050 HU and the marrow's 190 to 330: the band is the thicker one."""
    inside, cortex, _ = inside_at_400
    _, labels = spine
    l1 = 20  # its number in the labels
    assert 1.0 <= inside.volumes_ml["solid"] / (labels.counts[l1] * VOXEL_ML) <= 1.05  # measured 1.028
    assert 1.12 <= inside.volumes_ml["dense"] / (np.count_nonzero(cortex) * VOXEL_ML) <= 1.21  # measured 1.164
    assert inside.warnings == []


@pytest.mark.seconds
def test_canal_of_the_phantom_covers_its_true_canal_and_hardly_any_bone(spine, inside_at_400, device):
    _, labels = spine
    inside, _, true_canal = inside_at_400
    canal = inside.canal.to_numpy()
    slices = canal.any(axis=(1, 2))
    assert np.count_nonzero(canal & true_canal) >= 0.98 * np.count_nonzero(true_canal[slices])  # measured 0.992
    bone = clrecon.Mask.from_labels(inside.volume, labels, ["L1"], device=device).to_numpy()
    assert np.count_nonzero(canal & bone) < 0.001 * np.count_nonzero(canal)  # measured 3e-4
    assert inside.canal_found.height_mm == pytest.approx(13.0, abs=3.0)  # its pedicles are 14 mm high


@pytest.mark.seconds
def test_canal_of_a_grown_solid_is_that_of_the_true_bone(inside_at_400, inside_20):
    inside, _, _ = inside_at_400
    assert inside.volumes_ml["canal"] == pytest.approx(inside_20.volumes_ml["canal"], rel=0.003)  # measured 0.001


@pytest.fixture(scope="module")
def inside_20(spine, device):
    """Label 20, L1 of the phantom, taken apart as it is."""
    volume, labels = spine
    return clrecon.vertebra_inside(volume, labels, 20, device=device)


def test_dense_and_trabecular_bone_fill_the_solid_beside_the_canal(inside_20):
    assert list(inside_20.masks) == list(PARTS)
    assert not (inside_20.dense & inside_20.trabecular).count
    assert not (inside_20.canal & inside_20.solid).count
    assert ((inside_20.dense | inside_20.trabecular) ^ inside_20.solid).count == 0
    volumes = inside_20.volumes_ml
    assert volumes["dense"] + volumes["trabecular"] == pytest.approx(volumes["solid"])


def test_dense_bone_begins_at_450_hu(inside_20):
    voxels = inside_20.volume.voxels
    assert voxels[inside_20.dense.to_numpy()].min() >= 450
    assert (voxels[inside_20.trabecular.to_numpy()] < 450).all()


@pytest.fixture(scope="module")
def meshes_of_20(inside_20):
    return inside_20.extract_meshes()


@pytest.mark.parametrize("part", PARTS)
def test_mesh_of_a_part_is_closed_and_encloses_its_volume(inside_20, meshes_of_20, part):
    mesh = meshes_of_20[part]
    quality = mesh.quality()
    assert (quality.closed, quality.manifold) == (True, True)
    assert quality.volume_ml == pytest.approx(inside_20.volumes_ml[part], rel=0.001)  # measured 2e-4
    assert mesh.report["label_name"] == part


def test_meshes_of_dense_and_trabecular_bone_share_the_vertices_of_their_border(meshes_of_20):
    dense, trabecular = ({tuple(vertex) for vertex in meshes_of_20[part].vertices} for part in ("dense", "trabecular"))
    assert len(dense & trabecular) > 1000  # measured 15,789


def test_label_map_of_a_vertebra_has_its_parts(spine, inside_20, device):
    volume, _ = spine
    found = inside_20.to_label_map()
    assert found.names == {1: "dense", 2: "trabecular", 3: "canal"}
    whole = clrecon.Mask.from_labels(volume, found, ["dense"], device=device)  # the same voxels of the whole scan
    assert whole.count == inside_20.dense.count


def test_dict_of_a_vertebra_has_its_volumes_band_and_origin(inside_20):
    told = json.loads(json.dumps(inside_20.as_dict()))
    assert told["volumes_ml"] == inside_20.volumes_ml
    assert told["dense_hu"] == [450.0, None]
    assert told["solid_of"] == "label"


def test_text_of_a_vertebra_names_its_solid(inside_20):
    assert "solid" in repr(inside_20)


def test_pickling_a_vertebra_is_refused_with_what_can_be_pickled(inside_20):
    with refused(TypeError, "to_label_map", "as_dict"):
        pickle.dumps(inside_20)


def plate_in_a_label(thickness):
    """A plate of 900 HU across k, `thickness` voxels of 0.5 mm thick, in a filled label around it."""
    voxels = np.full((24, 40, 40), 100, np.int16)
    voxels[6 : 6 + thickness, 8:32, 8:32] = 900
    labels = np.zeros(voxels.shape, np.uint8)
    labels[4:20, 6:34, 6:34] = 1
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    return Volume(voxels, affine), LabelMap(labels, affine, names={1: "plate"})


def thickness_of_plate(voxels, device):
    """Of a plate of so many voxels of 0.5 mm."""
    volume, _ = plate_in_a_label(thickness=voxels)
    return measure_thickness(clrecon.Mask.from_band(volume, (450, np.inf), device=device))


@pytest.mark.parametrize("voxels", [1, 2])
def test_thickness_of_up_to_two_voxels_is_not_resolved(voxels, device):
    found = thickness_of_plate(voxels, device)
    assert found.limit_mm == 2 * 0.5
    assert (found.resolved_share, found.median_mm, found.p95_mm) == (0.0, None, None)


@pytest.mark.parametrize("voxels", [3, 5, 9])
def test_thickness_of_more_than_two_voxels_is_measured(voxels, device):
    found = thickness_of_plate(voxels, device)
    assert found.resolved_share > 0.85  # balls leave its edges out; measured from 0.89 on
    assert found.median_mm == pytest.approx(0.5 * voxels)


@pytest.fixture(scope="module")
def plate_inside(device):
    """A label without an arch: a plate of 4 voxels in it."""
    volume, labels = plate_in_a_label(thickness=4)
    return clrecon.vertebra_inside(volume, labels, "plate", device=device)


def test_a_label_without_a_closed_arch_has_no_canal_with_a_warning(plate_inside):
    assert plate_inside.canal is None
    assert plate_inside.as_dict()["volumes_ml"]["canal"] is None
    assert plate_inside.warnings == [
        "no canal of label 1 plate: its arch is closed in no slice, nor in some neighbouring slices together"
    ]


def test_a_label_without_a_closed_arch_has_its_other_parts(plate_inside):
    assert list(plate_inside.masks) == ["dense", "trabecular", "solid"]
    assert set(plate_inside.extract_meshes()) == {"dense", "trabecular", "solid"}


@pytest.fixture(scope="module")
def plate_in_uneven_slices(device):
    """The plate of 4 slices and 24 x 24 voxels of 0.5 mm, in slices 0.4 and 0.6 mm apart in turn."""
    volume, labels = plate_in_a_label(thickness=4)
    heights = np.cumsum(np.where(np.arange(24) % 2, 0.4, 0.6))
    uneven = Volume(
        volume.voxels, volume.affine, slice_positions=np.stack([np.zeros(24), np.zeros(24), heights], axis=1)
    )
    return clrecon.vertebra_inside(uneven, labels, "plate", device=device)


def test_dense_bone_in_uneven_slices_has_its_volume(plate_in_uneven_slices):
    assert plate_in_uneven_slices.volumes_ml["dense"] == pytest.approx(4 * 24 * 24 * 0.5**3 / 1000)


def test_meshes_of_a_vertebra_in_uneven_slices_are_refused(plate_in_uneven_slices):
    with refused(UsageError, "slices", "scan"):
        plate_in_uneven_slices.extract_meshes()


def short_label():
    """The plate begins at slice 6, its label at slice 7."""
    volume, labels = plate_in_a_label(thickness=4)
    short = np.zeros_like(labels.voxels)
    short[7:19, 6:34, 6:34] = 1
    return volume, LabelMap(short, labels.affine, names={1: "plate"})


def test_a_label_that_ends_before_its_bone_is_warned_of(device):
    volume, labels = short_label()
    warnings = clrecon.vertebra_inside(volume, labels, 1, device=device).warnings
    assert any("25 % of the bone of 450 HU and above" in warning for warning in warnings)  # a slice of four


def test_a_label_that_ends_before_its_bone_is_grown_to_it_by_a_level_without_a_warning(device):
    volume, labels = short_label()
    grown = clrecon.vertebra_inside(volume, labels, 1, iso_value=300, device=device)
    assert grown.dense.count == 4 * 24 * 24
    assert not any("outside of the label" in warning for warning in grown.warnings)


def test_a_label_that_the_scan_cuts_ends_there_with_a_warning(device):
    """Slices 4 to 19 of a label of 28 x 28 voxels, in a scan of 12 slices."""
    volume, labels = plate_in_a_label(thickness=4)
    cut = Volume(volume.voxels[:12], volume.affine)
    inside = clrecon.vertebra_inside(cut, labels, 1, device=device)
    assert inside.solid.count == 8 * 28 * 28
    assert inside.inside_share == pytest.approx(8 / 16)
    assert "50 % of label 1 plate lie outside the CT: the vertebra ends where the CT does" in inside.warnings


@pytest.mark.parametrize(
    ("band", "name"),
    [((450, None), "450 HU and above"), ((350, 900), "350 to 900 HU"), ((None, 900), "900 HU and below")],
)
def test_bands_are_named_by_their_ends(band, name):
    assert name_band(band) == name


@pytest.mark.parametrize("dense", [(900, 450), (None, None), (450,), "x", (np.nan, 900), 450])
def test_a_band_of_dense_bone_that_is_no_two_ascending_numbers_is_refused(dense, device):
    volume, labels = plate_in_a_label(thickness=4)
    with refused(UsageError, "dense", "bone"):
        clrecon.vertebra_inside(volume, labels, 1, dense=dense, device=device)


@pytest.mark.parametrize("dense", [(2000, None), (1e6, 2e6)])
def test_a_band_without_bone_is_refused(dense, device):
    volume, labels = plate_in_a_label(thickness=4)
    with refused(NoSurfaceError, 1, 100, 900):
        clrecon.vertebra_inside(volume, labels, 1, dense=dense, device=device)


@pytest.fixture(scope="module")
def real_scan(real_data):
    """A scan in voxels of 3 mm, and the labels that a network drew."""
    folder = real_data / "thoracolumbar_labels"
    volume = clrecon.read_volume(folder / "example_ct.nii.gz")
    return volume, clrecon.read_labels(folder / "spine_report" / "totalseg.nii.gz")


@pytest.mark.parametrize("name", ["L3", "L4", "T12"])
def test_volume_canal_and_cortex_of_a_real_vertebra_are_plausible(real_scan, name, device):
    volume, labels = real_scan
    inside = clrecon.vertebra_inside(volume, labels, name, dense=(300, None), device=device)
    assert inside.volumes_ml["solid"] == pytest.approx(
        labels.counts[inside.label] * 3.0**3 / 1000, rel=0.01
    )  # voxels of 3 mm
    assert 3.0 <= inside.volumes_ml["canal"] <= 6.0  # measured 3.9 to 4.6
    assert 12.0 <= inside.canal_found.height_mm <= 21.0  # measured 15 to 18
    assert inside.thickness.resolved_share < 0.3  # cortex is thinner than a voxel


def test_a_real_vertebra_of_which_2_ml_are_in_the_scan_has_no_canal(real_scan, device):
    volume, labels = real_scan
    inside = clrecon.vertebra_inside(volume, labels, "T11", dense=(300, None), device=device)
    assert inside.volumes_ml["solid"] == pytest.approx(2.0, abs=0.1)  # measured 2.052
    assert inside.canal is None


@pytest.mark.seconds
def test_a_low_canal_and_gaps_of_a_real_label_are_warned_of(real_data, device):
    """The map has the spinal cord too."""
    folder = real_data / "thoracolumbar_labels"
    volume = clrecon.read_volume(folder / "ct_2mm_jpeg2000")
    labels = clrecon.read_labels(folder / "ct_2mm_labels.nii.gz")
    inside = clrecon.vertebra_inside(volume, labels, "T12", device=device)
    assert inside.volumes_ml["canal"] == pytest.approx(1.5, abs=0.2)  # measured
    warnings = " ".join(inside.warnings)
    assert "the canal of label 32 vertebrae_T12 is 4 mm high: pedicles are higher" in warnings
    assert "in the next voxel outside of the label" in warnings


@pytest.mark.parametrize("turned", daily(1, [{"tilt": 15.0}, {"oblique": (10.0, -5.0, 30.0)}]), ids=str)
def test_solid_and_canal_in_tilted_and_oblique_scans_are_those_in_straight_ones(turned, device):
    settings = PhantomSettings(levels="L1", size=(130, 130), spacing=(1.0, 1.0, 1.2), **turned)
    voxels, affine, _ = make_phantom(settings)
    truth = clrecon.phantom_truth(settings)
    labels = LabelMap(truth.label_map(), affine, names=truth.names)
    inside = clrecon.vertebra_inside(Volume(voxels, affine), labels, "L1", device=device)
    # Measured in straight slices.
    assert inside.volumes_ml["solid"] == pytest.approx(35.76, rel=0.01)
    assert inside.volumes_ml["canal"] == pytest.approx(5.5, rel=0.1)  # measured 5.24
    assert inside.canal_found.height_mm == pytest.approx(13.8, abs=1.8)  # a slice and a half


def test_volume_and_canal_of_each_real_mask_are_plausible(real_data, device):
    labels = clrecon.read_labels(real_data / "vertebra_masks" / "sub-verse004_seg-vert_msk.nii.gz")  # sagittal slices
    volume = Volume(np.where(labels.voxels > 0, 500, 0).astype(np.int16), labels.affine)
    voxel_ml = abs(np.linalg.det(labels.affine[:3, :3])) / 1000
    assert len(labels.numbers) > 1
    for number in labels.numbers:
        inside = clrecon.vertebra_inside(volume, labels, number, device=device)
        assert inside.volumes_ml["solid"] == pytest.approx(labels.counts[number] * voxel_ml, rel=0.01)  # measured 0.003
        assert 1.5 <= inside.volumes_ml["canal"] <= 5.0  # measured 1.8 to 4.1
        assert 10.0 <= inside.canal_found.height_mm <= 18.0  # measured 11 to 17
