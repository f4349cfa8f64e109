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
    voxels, affine, _ = make_phantom(SPINE)
    truth = clrecon.phantom_truth(SPINE)
    return Volume(voxels, affine), LabelMap(truth.label_map(), affine, truth.names)


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


@pytest.mark.seconds
def test_volumes_are_those_of_the_phantom(spine, device):
    volume, labels = spine
    inside = clrecon.vertebra_inside(volume, labels, "L1", 400, device=device)
    cortex, ellipse = truth_of(inside.volume, volume.affine, "L1")
    ml = 0.49e-3
    assert 1.0 <= inside.volumes_ml["solid"] / (labels.counts[20] * ml) <= 1.05
    # 450 HU is not half of the cortex's 850 to 1050 HU and the marrow's 190 to 330: the band is thicker than the cortex
    assert 1.12 <= inside.volumes_ml["dense"] / (cortex.sum() * ml) <= 1.21
    canal = inside.canal.to_numpy()
    slices = canal.any(axis=(1, 2))
    assert (canal & ellipse).sum() >= 0.98 * ellipse[slices].sum()
    bone = clrecon.Mask.from_labels(inside.volume, labels, ["L1"], device=device).to_numpy()
    assert (canal & bone).sum() < 0.01 * canal.sum()
    assert 10.0 <= inside.canal_found.height_mm <= 16.0  # its pedicles are 14 mm high
    exact = clrecon.vertebra_inside(volume, labels, "L1", device=device)  # the hole of the true bone
    assert inside.volumes_ml["canal"] == pytest.approx(exact.volumes_ml["canal"], rel=0.1)
    assert inside.warnings == []


@pytest.fixture(scope="module")
def inside_20(spine, device):
    """Vertebra 20 of the phantom, taken apart."""
    return clrecon.vertebra_inside(*spine, 20, device=device)


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


def test_meshes_of_parts_are_closed_and_enclose_their_volumes(inside_20):
    meshes = inside_20.extract_meshes()
    assert list(meshes) == list(PARTS)
    for name, mesh in meshes.items():
        quality = mesh.quality()
        assert quality.closed and quality.manifold and mesh.report["label_name"] == name
        assert quality.volume_ml == pytest.approx(inside_20.volumes_ml[name], rel=0.01)
    shared = {tuple(vertex) for vertex in meshes["dense"].vertices} & {tuple(v) for v in meshes["trabecular"].vertices}
    assert len(shared) > 1000


def test_label_map_of_a_vertebra_has_its_parts(spine, inside_20, device):
    found = inside_20.to_label_map()
    assert found.names == {1: "dense", 2: "trabecular", 3: "canal"}
    whole = clrecon.Mask.from_labels(spine[0], found, ["dense"], device=device)  # the same voxels of the whole scan
    assert whole.count == inside_20.dense.count


def test_dict_of_a_vertebra_says_its_volumes_and_what_they_are_of(inside_20):
    told = json.loads(json.dumps(inside_20.as_dict()))
    assert told["volumes_ml"] == inside_20.volumes_ml
    assert told["dense_hu"] == [450.0, None]
    assert told["solid_of"] == "label"


def test_vertebra_cannot_be_pickled_and_says_what_can(inside_20):
    assert "solid" in repr(inside_20)
    with refused(TypeError, "to_label_map", "as_dict"):
        pickle.dumps(inside_20)


def slab(thickness, spacing=(0.5, 0.5, 0.5), hu=900):
    """A plate across k, `thickness` voxels thick, in a filled label around it."""
    voxels = np.full((24, 40, 40), 100, np.int16)
    voxels[6 : 6 + thickness, 8:32, 8:32] = hu
    labels = np.zeros(voxels.shape, np.uint8)
    labels[4:20, 6:34, 6:34] = 1
    affine = np.diag([*spacing, 1.0])
    return Volume(voxels, affine), LabelMap(labels, affine, {1: "plate"})


@pytest.mark.parametrize("thickness", [1, 2, 3, 5, 9])
def test_thickness_is_said_where_it_exceeds_two_voxels(thickness, device):
    volume, _ = slab(thickness)
    found = measure_thickness(clrecon.Mask.from_band(volume, (450, np.inf), device=device))
    assert found.limit_mm == 1.0
    if thickness <= 2:
        assert (found.resolved_share, found.median_mm, found.p95_mm) == (0.0, None, None)
    else:
        assert found.resolved_share > 0.85  # balls leave its edges out
        assert found.median_mm == pytest.approx(0.5 * thickness)


def test_an_arch_that_is_not_closed_has_no_canal_and_all_else(device):
    volume, labels = slab(4)
    inside = clrecon.vertebra_inside(volume, labels, "plate", device=device)
    assert inside.canal is None
    assert list(inside.masks) == ["dense", "trabecular", "solid"]
    assert inside.warnings == [
        "no canal of label 1 plate: its arch is closed in no slice, nor in some neighbouring slices together"
    ]
    assert set(inside.extract_meshes()) == {"dense", "trabecular", "solid"}
    assert inside.as_dict()["volumes_ml"]["canal"] is None


def test_uneven_slices_have_masks_and_volumes_but_no_meshes(device):
    volume, labels = slab(4)
    positions = np.stack([np.zeros(24), np.zeros(24), np.cumsum(np.where(np.arange(24) % 2, 0.4, 0.6))], axis=1)
    uneven = Volume(volume.voxels, volume.affine, slice_positions=positions)
    inside = clrecon.vertebra_inside(uneven, labels, "plate", device=device)
    assert inside.volumes_ml["dense"] == pytest.approx(4 * 24 * 24 * 0.125e-3)
    with refused(UsageError, "slices", "scan"):
        inside.extract_meshes()


def test_a_label_that_ends_before_its_bone_is_warned_of(device):
    volume, labels = slab(4)
    short = np.zeros_like(labels.voxels)
    short[7:19, 6:34, 6:34] = 1  # the plate begins at slice 6
    short_map = LabelMap(short, labels.affine, {1: "plate"})
    told = clrecon.vertebra_inside(volume, short_map, 1, device=device).warnings
    assert any("25 % of the bone of 450 HU and above" in warning for warning in told)
    grown = clrecon.vertebra_inside(volume, short_map, 1, 300, device=device)
    assert grown.dense.count == 4 * 24 * 24
    assert not any("outside of the label" in warning for warning in grown.warnings)


def test_a_cut_label_is_told(device):
    volume, labels = slab(4)
    part = Volume(volume.voxels[:12], volume.affine)
    inside = clrecon.vertebra_inside(part, labels, 1, device=device)
    assert inside.inside_share == pytest.approx(0.5)
    assert "50 % of label 1 plate lie outside the CT: the vertebra ends where the CT does" in inside.warnings
    assert inside.solid.count == 8 * 28 * 28


def test_bands_are_named_by_their_ends():
    assert name_band((450, None)) == "450 HU and above"
    assert name_band((350, 900)) == "350 to 900 HU"
    assert name_band((None, 900)) == "900 HU and below"


@pytest.mark.parametrize("dense", [(900, 450), (None, None), (450,), "x", (np.nan, 900), 450])
def test_a_band_that_is_none_is_refused(dense, device):
    volume, labels = slab(4)
    with refused(UsageError, "dense", "bone"):
        clrecon.vertebra_inside(volume, labels, 1, dense=dense, device=device)


@pytest.mark.parametrize("dense", [(2000, None), (1e6, 2e6)])
def test_a_band_without_bone_is_refused(dense, device):
    volume, labels = slab(4)
    with refused(NoSurfaceError, 1, 100, 900):
        clrecon.vertebra_inside(volume, labels, 1, dense=dense, device=device)


def test_canals_and_volumes_of_real_vertebrae_are_plausible(real_data, device):
    folder = real_data / "thoracolumbar_labels"
    volume = clrecon.read_volume(folder / "example_ct.nii.gz")  # 3 mm: cortex is thinner than a voxel
    labels = clrecon.read_labels(folder / "spine_report" / "totalseg.nii.gz")
    for name, low, high in (("L3", 3.0, 6.0), ("L4", 3.0, 6.0), ("T12", 3.0, 6.0)):
        inside = clrecon.vertebra_inside(volume, labels, name, dense=(300, None), device=device)
        label_ml = labels.counts[inside.label] * 27e-3
        assert inside.volumes_ml["solid"] == pytest.approx(label_ml, rel=0.01)
        assert low <= inside.volumes_ml["canal"] <= high
        assert 12.0 <= inside.canal_found.height_mm <= 21.0
        assert inside.thickness.resolved_share < 0.3
    cut = clrecon.vertebra_inside(volume, labels, "T11", dense=(300, None), device=device)  # 2 ml of it are in the scan
    assert cut.canal is None


@pytest.mark.seconds
def test_a_real_label_with_gaps_is_warned_of(real_data, device):
    folder = real_data / "thoracolumbar_labels"
    volume, labels = (
        clrecon.read_volume(folder / "ct_2mm_jpeg2000"),
        clrecon.read_labels(folder / "ct_2mm_labels.nii.gz"),
    )
    inside = clrecon.vertebra_inside(volume, labels, "T12", device=device)  # the map has the spinal cord too
    assert inside.volumes_ml["canal"] == pytest.approx(1.5, abs=0.2)
    told = " ".join(inside.warnings)
    assert "the canal of label 32 vertebrae_T12 is 4 mm high: pedicles are higher" in told
    assert "in the next voxel outside of the label" in told


@pytest.mark.parametrize("turned", daily(1, [{"tilt": 15.0}, {"oblique": (10.0, -5.0, 30.0)}]), ids=str)
def test_tilted_and_oblique_scans_have_the_same_parts(turned, device):
    settings = PhantomSettings(levels="L1", size=(130, 130), spacing=(1.0, 1.0, 1.2), **turned)
    voxels, affine, _ = make_phantom(settings)
    truth = clrecon.phantom_truth(settings)
    labels = LabelMap(truth.label_map(), affine, truth.names)
    inside = clrecon.vertebra_inside(Volume(voxels, affine), labels, "L1", device=device)
    assert inside.volumes_ml["solid"] == pytest.approx(35.76, rel=0.01)
    assert inside.volumes_ml["canal"] == pytest.approx(5.5, rel=0.1)
    assert 12.0 <= inside.canal_found.height_mm <= 15.6


def test_canals_of_real_masks_are_plausible(real_data, device):
    labels = clrecon.read_labels(real_data / "vertebra_masks" / "sub-verse004_seg-vert_msk.nii.gz")  # sagittal slices
    volume = Volume(np.where(labels.voxels > 0, 500, 0).astype(np.int16), labels.affine)
    for number in labels.numbers:
        inside = clrecon.vertebra_inside(volume, labels, number, device=device)
        assert inside.volumes_ml["solid"] == pytest.approx(labels.counts[number] * 2e-3, rel=0.01)
        assert 1.5 <= inside.volumes_ml["canal"] <= 5.0
        assert 10.0 <= inside.canal_found.height_mm <= 18.0
