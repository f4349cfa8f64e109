"""Rules of jobs on a few values: what settings mean, what they refuse, and what reports hold, without a scan."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.jobs import corridor_results
from clrecon.jobs.mesh import bone, make, purposes
from clrecon.jobs.mesh.purposes import settings_for
from clrecon.jobs.mesh.seeds import check_growing
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.mesh.surfaces import Surface, check_known_values, choose_level, plan_surfaces
from clrecon.jobs.options import parse_bytes, parse_hu, parse_preprocess
from clrecon.jobs.render.job import PictureFiles, check_pictures, find_emptiness, make_pictures
from clrecon.jobs.render.settings import RenderSettings
from clrecon.jobs.vertebrae import picture_beside
from clrecon.jobs.view import inputs
from clrecon.jobs.view import job as view_job
from clrecon.mesh import Mesh
from clrecon.mesh.compare.walls import WallLook
from clrecon.spine.corridors import screw_diameter

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("kind", ["nii", "nii.gz", "dcm", "NII.GZ"])
def test_picture_of_vertebrae_is_named_after_the_label_map_beside_it(kind: str) -> None:
    assert picture_beside(f"a.b/spine.{kind}") == "a.b/spine.png"


def test_band_of_a_surface_holds_the_hu_that_it_encloses() -> None:
    above, below = Surface("", iso_value=200.0), Surface("", iso_value=-400.0, below=True)
    between, of_a_mask = Surface("", iso_value=(100.0, 300.0)), Surface("", iso_value=None)
    surfaces = [above, below, between, of_a_mask]
    assert make._bands_of(surfaces) == [(200.0, math.inf), (-math.inf, -400.0), (100.0, 300.0)]


@pytest.fixture
def raw_volume() -> Any:
    """A volume whose values are not known to be HU."""
    return SimpleNamespace(report={"gates": [{"name": "hu_known", "ok": False, "text": "no slope"}]})


@pytest.mark.parametrize(
    "given", [{"purpose": "print"}, {"purpose": "print", "half_way": "auto"}], ids=["preset of bone", "auto"]
)
def test_print_of_values_that_are_not_known_to_be_hu_is_refused_without_a_level(
    given: dict[str, Any], raw_volume: Any
) -> None:
    with refused(RefusedInputError, "hu_known", "slope"):
        check_known_values(raw_volume, MeshSettings(**given))


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"purpose": "print", "iso_value": (200.0,)},
        {"purpose": "print", "half_way": (1200.0, 40.0)},
        {"purpose": "print", "labels": LabelChoice("a", surface="mask")},
    ],
    ids=["no print", "iso value", "two materials", "surface of labels"],
)
def test_mesh_of_values_that_are_not_known_to_be_hu_is_accepted_where_none_is_assumed(
    given: dict[str, Any], raw_volume: Any
) -> None:
    assert check_known_values(raw_volume, MeshSettings(**given)) is None


def test_given_iso_value_or_materials_are_not_chosen_from_the_scan() -> None:
    volume: Any = None
    assert choose_level(volume, MeshSettings(iso_value=(200.0,))) is None
    chosen = choose_level(volume, MeshSettings(half_way=(1200.0, 40.0)))
    assert chosen is not None and (chosen.bone_hu, chosen.tissue_hu) == (1200.0, 40.0)


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ("auto", {"half_way": "auto"}),
        ("half:1200,40", {"half_way": (1200.0, 40.0)}),
        ("2", {"iso_value": (2.0,)}),
        ("100:300,5", {"iso_value": ((100.0, 300.0), 5.0)}),
    ],
)
def test_option_hu_is_read_as_a_setting(text: str, fields: dict[str, Any]) -> None:
    assert parse_hu(text) == fields


@pytest.mark.parametrize("text", ["half:1", "half:1,2,3"])
def test_option_hu_half_way_between_other_than_two_materials_is_refused(text: str) -> None:
    with refused(ValueError, "materials"):
        parse_hu(text)


@pytest.mark.parametrize(
    ("text", "size"), [("5", 5), ("5B", 5), ("5k", 5000), ("2KiB", 2048), ("1.5 GB", 1_500_000_000)]
)
def test_size_of_memory_is_read_in_bytes(text: str, size: int) -> None:
    assert parse_bytes(text) == size


def test_size_of_memory_in_an_unknown_unit_is_refused() -> None:
    with refused(ValueError, "memory"):
        parse_bytes("5i")


@pytest.mark.parametrize("text", ["unknown", "level:1:2", "level:nan", "region:1", "median:0"])
def test_unknown_step_of_preprocessing_is_refused(text: str) -> None:
    with refused(UsageError, "step"):
        parse_preprocess(text)


@pytest.mark.parametrize(
    ("given", "solid"),
    [({}, True), ({"solid": False}, None), ({"solid": True}, True), ({"iso_value": (200.0, 300.0)}, None)],
)
def test_print_at_one_iso_value_is_solid_unless_it_is_asked_to_be_hollow(
    given: dict[str, Any], solid: bool | None
) -> None:
    assert bool(settings_for("print", given).get("solid")) is bool(solid)


@pytest.mark.parametrize(("solid", "filled"), [(None, True), (False, False)])
def test_labels_of_a_print_are_solid_unless_it_is_asked_to_be_hollow(solid: bool | None, filled: bool) -> None:
    labels = settings_for("print", {"labels": LabelChoice("a"), **({} if solid is None else {"solid": solid})})[
        "labels"
    ]
    assert labels.solid is filled


def test_topology_of_labels_is_refused() -> None:
    with refused(UsageError, "labels"):
        MeshSettings(labels=LabelChoice("a"), topology="trilinear")


def check_growing_of(method: str, grow_from: tuple[str, ...], *, has_labels: bool, makes_labels: bool) -> None:
    check_growing(
        method, grow_from, "linear", topology="separated", inside="above", has_labels=has_labels,
        makes_labels=makes_labels,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("grow_from", "has_labels", "makes_labels", "fact"),
    [
        pytest.param(("label:L3",), False, False, "map", id="from a label without a map"),
        pytest.param(("label:L3",), True, True, "meshes", id="into meshes of labels"),
        pytest.param(("auto",), True, False, "cells", id="labels without a use"),
    ],
)
def test_growing_that_does_not_fit_the_labels_is_refused(
    grow_from: tuple[str, ...], has_labels: bool, makes_labels: bool, fact: str
) -> None:
    with refused(UsageError, fact):
        check_growing_of("i-mc", grow_from, has_labels=has_labels, makes_labels=makes_labels)


@pytest.mark.parametrize("has_labels", [True, False])
def test_method_that_does_not_grow_is_accepted_with_and_without_labels(has_labels: bool) -> None:
    assert check_growing_of("t-mc", (), has_labels=has_labels, makes_labels=has_labels) is None


@pytest.mark.parametrize(
    ("given", "selects"),
    [({}, False), ({"keep": "bone"}, True), ({"split": True}, True), ({"keep_largest": 1}, True),
     ({"min_volume_ml": 0.1}, True), ({"seeds": ((0.0, 0.0, 0.0),)}, True)],
)  # fmt: skip
def test_settings_that_choose_components_are_told_from_those_that_keep_all(
    given: dict[str, Any], selects: bool
) -> None:
    assert MeshSettings(**given).selects is selects


@pytest.mark.parametrize("radius", [None, 4.0])
def test_corridor_with_a_radius_has_the_diameter_of_a_screw_and_one_without_has_none(radius: float | None) -> None:
    names = (  # all that is described of a corridor; here only the radius is known
        *("side", "refused", "length", "medial_deg", "sagittal_deg", "medial_range_deg", "sagittal_range_deg", "tried"),
        *("medial_lps_deg", "sagittal_lps_deg", "entry", "tip", "back", "pass_point", "margins", "canal", "bias"),
        *("by_hu_share", "width_voxels"),
    )
    corridor: Any = SimpleNamespace(**dict.fromkeys(names), radius=radius)
    margin_mm = 1.0
    found = corridor_results.describe_corridor(corridor, margin_mm, "LPS")["screw_diameter_mm"]
    assert found == (None if radius is None else screw_diameter(radius, margin_mm))


def test_file_in_lps_has_no_warning_of_its_frame() -> None:
    assert inputs._describe_frame("a", {"space": "LPS", "warnings": []}) == ()


def test_file_turned_from_ras_has_a_warning_before_its_own() -> None:
    assert inputs._describe_frame("a", {"space": "RAS", "warnings": ["w"]}) == ("a was turned from RAS to LPS", "w")


def read_input(*reports: dict[str, Any]) -> Any:
    """What a file of a box for each report gives."""
    return SimpleNamespace(meshes=[Mesh(*samples.box(), report=report) for report in reports])


def test_single_mesh_of_a_page_gets_no_name_and_no_colour() -> None:
    (mesh,) = view_job._name_and_color([read_input({})], SimpleNamespace(names=[]))  # type: ignore[arg-type]
    assert mesh.report == {}


def test_meshes_of_a_page_get_the_given_names_then_numbers_and_one_colour_a_file() -> None:
    red = [1, 0, 0]
    files = [read_input({"color": red}), read_input({"part_name": "a"}, {})]
    settings: Any = SimpleNamespace(names=["left"])

    first, second, third = view_job._name_and_color(files, settings)

    names = [mesh.report["part_name"] for mesh in (first, second, third)]
    assert names == ["left", "surface 2 a", "surface 2"]
    assert first.report["color"] == red  # its own
    assert second.report["color"] == third.report["color"] != red


def warn_of_surface(
    monkeypatch: pytest.MonkeyPatch, *, looks_like: str, contrast_share: float, bones: Any = None
) -> list[str]:
    """Warnings for a surface whose walls look so, in a scan with this share of contrast medium."""
    monkeypatch.setattr(bone, "warn_of_contrast", lambda choice: ["contrast"])
    (surface,) = plan_surfaces([200.0])
    shares = dict.fromkeys(("compact_share", "contrast_share", "metal_share"), 0.0)
    look = WallLook(looks_like, **shares, wall_hu={"median": 300.0, "p99": 400.0}, samples=1000)
    part: Any = SimpleNamespace(surface=surface, bones=bones, facts={"walls": look})
    choice: Any = SimpleNamespace(contrast_medium_share=contrast_share)
    return bone.warn_of_walls([part], MeshSettings(), choice)


BONELESS = SimpleNamespace(bone=0, components=3, rails=0)


def test_surface_of_contrast_medium_is_warned_of_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    contrast, whole = warn_of_surface(monkeypatch, looks_like="contrast medium", contrast_share=0.3)

    assert contrast == "contrast"
    assert "keeps what looks like bone" in whole


def test_surface_without_bone_has_no_advice_on_contrast_medium(monkeypatch: pytest.MonkeyPatch) -> None:
    (warning,) = warn_of_surface(monkeypatch, looks_like="no bone", bones=BONELESS, contrast_share=0.3)
    assert "nothing here looks like bone, none of 3 components" in warning


def test_surface_without_bone_is_warned_of_too_where_contrast_medium_is_not_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    contrast, none = warn_of_surface(monkeypatch, looks_like="no bone", bones=BONELESS, contrast_share=0.0)

    assert contrast == "contrast"
    assert "nothing here looks like bone" in none


@pytest.mark.parametrize(
    ("depth", "values", "words"),
    [(5.0, None, None), (np.nan, None, "nothing of the"), (5.0, np.nan, None)],
    ids=["a surface is hit", "nothing is hit", "hit, without values"],
)
def test_picture_without_any_depth_is_warned_of_as_empty(depth: float, values: float | None, words: str | None) -> None:
    def full(value: float) -> np.ndarray:
        return np.full((2, 2), value)

    picture: Any = SimpleNamespace(
        depth=full(depth), values=None if values is None else full(values), mode="surface", report={}
    )
    found = find_emptiness(picture)
    assert found is None if words is None else words in str(found)


def test_part_without_figures_of_a_print_has_no_warning_of_it() -> None:
    part: Any = SimpleNamespace(facts={}, name="")
    nothing: Any = None
    assert purposes.describe_purposes([part], MeshSettings(), nothing, nothing) == [] and part.facts == {"print": None}


def test_transparent_background_of_a_jpeg_is_refused(tmp_path: Any) -> None:
    with refused(UsageError, "JPG", "background"):
        check_pictures(PictureFiles(str(tmp_path / "a.jpg")), RenderSettings(background="transparent"))


def test_transparent_background_of_a_png_is_accepted(tmp_path: Any) -> None:
    picture = str(tmp_path / "a.png")
    checked = check_pictures(PictureFiles(picture), RenderSettings(background="transparent"))
    assert checked == [("the picture", picture)]


def test_turntable_with_a_file_and_no_turn_is_refused(tmp_path: Any) -> None:
    with pytest.raises(UsageError, match="a turntable needs both"):
        make_pictures("a", PictureFiles(turntable=str(tmp_path / "a.gif")), RenderSettings())
