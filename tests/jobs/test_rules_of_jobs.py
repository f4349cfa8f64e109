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
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings, check_growing
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
def test_a_picture_lies_beside_its_label_map(kind: str) -> None:
    assert picture_beside(f"a.b/spine.{kind}") == "a.b/spine.png"


def test_bands_are_what_surfaces_enclose() -> None:
    surfaces = [Surface("", 200.0), Surface("", -400.0, below=True), Surface("", (100.0, 300.0)), Surface("", None)]
    assert make._bands_of(surfaces) == [(200.0, math.inf), (-math.inf, -400.0), (100.0, 300.0)]


@pytest.mark.parametrize(
    ("given", "is_refused"),
    [
        ({"purpose": "print"}, True), ({"purpose": "print", "iso_value": (200.0,)}, False), ({}, False),
        ({"purpose": "print", "half_way": (1200.0, 40.0)}, False), ({"purpose": "print", "half_way": "auto"}, True),
        ({"purpose": "print", "labels": LabelChoice("a", surface="mask")}, False),
    ],
)  # fmt: skip
def test_a_print_needs_a_level_that_is_known(given: dict[str, Any], is_refused: bool) -> None:
    volume: Any = SimpleNamespace(report={"gates": [{"name": "hu_known", "ok": False, "text": "no slope"}]})
    settings = MeshSettings(**given)
    if is_refused:
        with refused(RefusedInputError, "hu_known", "slope"):
            check_known_values(volume, settings)
    else:
        check_known_values(volume, settings)


def test_levels_that_are_named_are_not_chosen() -> None:
    volume: Any = None
    assert choose_level(volume, MeshSettings(iso_value=(200.0,))) is None
    chosen = choose_level(volume, MeshSettings(half_way=(1200.0, 40.0)))
    assert chosen is not None and (chosen.bone_hu, chosen.tissue_hu) == (1200.0, 40.0)


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ("auto", {"half_way": "auto"}), ("half:1200,40", {"half_way": (1200.0, 40.0)}), ("2", {"iso_value": (2.0,)}),
        ("100:300,5", {"iso_value": ((100.0, 300.0), 5.0)}), ("half:1", None), ("half:1,2,3", None),
    ],
)  # fmt: skip
def test_levels_are_read_from_text(text: str, fields: dict[str, Any] | None) -> None:
    if fields is None:
        with refused(ValueError, "materials"):
            parse_hu(text)
    else:
        assert parse_hu(text) == fields


@pytest.mark.parametrize(
    ("text", "size"), [("5", 5), ("5B", 5), ("5k", 5000), ("2KiB", 2048), ("1.5 GB", 1_500_000_000), ("5i", None)]
)
def test_memory_is_read_from_text(text: str, size: int | None) -> None:
    if size is None:
        with refused(ValueError, "memory"):
            parse_bytes(text)
    else:
        assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["unknown", "level:1:2", "level:nan", "region:1", "median:0"])
def test_steps_that_are_not_known_are_refused(text: str) -> None:
    with refused(UsageError, "step"):
        parse_preprocess(text)


@pytest.mark.parametrize(
    ("given", "solid"),
    [({}, True), ({"solid": False}, None), ({"solid": True}, True), ({"iso_value": (200.0, 300.0)}, None)],
)
def test_a_print_is_solid_at_one_level_unless_it_shall_not(given: dict[str, Any], solid: bool | None) -> None:
    assert bool(settings_for("print", given).get("solid")) is bool(solid)


@pytest.mark.parametrize(("solid", "filled"), [(None, True), (False, False)])
def test_labels_of_a_print_are_solid_one_by_one(solid: bool | None, filled: bool) -> None:
    labels = settings_for("print", {"labels": LabelChoice("a"), **({} if solid is None else {"solid": solid})})[
        "labels"
    ]
    assert labels.solid is filled


def test_labels_pick_cells_of_one_topology() -> None:
    MeshSettings(topology="trilinear")
    MeshSettings(labels=LabelChoice("a"))
    with refused(UsageError, "labels"):
        MeshSettings(labels=LabelChoice("a"), topology="trilinear")


def test_growing_from_labels_needs_them_and_makes_none() -> None:
    def check(method: str, grow_from: tuple[str, ...], has: bool, makes: bool) -> None:
        check_growing(
            method, grow_from, "linear", topology="separated", inside="above", has_labels=has, makes_labels=makes
        )

    check("t-mc", (), True, True)
    check("t-mc", (), False, False)
    for grow_from, has, makes, words in (
        (("label:L3",), False, False, "map"),
        (("label:L3",), True, True, "meshes"),
        (("auto",), True, False, "cells"),
    ):
        with refused(UsageError, words):
            check("i-mc", grow_from, has, makes)


@pytest.mark.parametrize(
    ("given", "selects"),
    [({}, False), ({"keep": "bone"}, True), ({"split": True}, True), ({"keep_largest": 1}, True),
     ({"min_volume_ml": 0.1}, True), ({"seeds": ((0.0, 0.0, 0.0),)}, True)],
)  # fmt: skip
def test_settings_say_whether_they_choose_components(given: dict[str, Any], selects: bool) -> None:
    assert MeshSettings(**given).selects is selects


@pytest.mark.parametrize("radius", [None, 4.0])
def test_a_corridor_has_a_screw_where_it_has_a_radius(radius: float | None) -> None:
    names = (
        *("side", "refused", "length", "medial_deg", "sagittal_deg", "medial_range_deg", "sagittal_range_deg", "tried"),
        *("medial_lps_deg", "sagittal_lps_deg", "entry", "tip", "back", "pass_point", "margins", "canal", "bias"),
        *("by_hu_share", "width_voxels"),
    )
    corridor: Any = SimpleNamespace(**dict.fromkeys(names), radius=radius)
    found = corridor_results.describe_corridor(corridor, 1.0, "LPS")["screw_diameter_mm"]
    assert found == (None if radius is None else screw_diameter(radius, 1.0))


def test_a_file_turned_from_ras_gives_a_warning() -> None:
    assert inputs._describe_frame("a", {"space": "LPS", "warnings": []}) == ()
    assert inputs._describe_frame("a", {"space": "RAS", "warnings": ["w"]}) == ("a was turned from RAS to LPS", "w")


def test_inputs_of_a_page_have_names_and_colours() -> None:
    def shown(*reports: dict[str, Any]) -> Any:
        return SimpleNamespace(meshes=[Mesh(*samples.box(), None, report) for report in reports])

    settings: Any = SimpleNamespace(names=["left"])
    (one,) = view_job._name_and_color([shown({})], SimpleNamespace(names=[]))  # type: ignore[arg-type]
    assert one.report == {}
    first, second, third = view_job._name_and_color(
        [shown({"color": [1, 0, 0]}), shown({"part_name": "a"}, {})], settings
    )
    assert [mesh.report["part_name"] for mesh in (first, second, third)] == ["left", "surface 2 a", "surface 2"]
    assert first.report["color"] == [1, 0, 0] and second.report["color"] == third.report["color"] != [1, 0, 0]


def test_a_surface_without_bone_has_no_advice_on_contrast_medium(monkeypatch: pytest.MonkeyPatch) -> None:
    def warnings_of(looks_like: str, bones: Any, contrast_share: float) -> list[str]:
        look = WallLook(looks_like, 0.0, 0.0, 0.0, {"median": 300.0, "p99": 400.0}, 1000)
        part: Any = SimpleNamespace(surface=surface, bones=bones, facts={"walls": look})
        choice: Any = SimpleNamespace(contrast_medium_share=contrast_share)
        return bone.warn_of_walls([part], MeshSettings(), choice)

    monkeypatch.setattr(bone, "warn_of_contrast", lambda choice: ["contrast"])
    (surface,) = plan_surfaces([200.0])
    boneless = SimpleNamespace(bone=0, components=3, rails=0)
    contrast, whole = warnings_of("contrast medium", None, 0.3)
    assert contrast == "contrast" and "keeps what looks like bone" in whole
    (none,) = warnings_of("no bone", boneless, 0.3)
    assert "nothing here looks like bone, none of 3 components" in none
    assert warnings_of("no bone", boneless, 0.0) == ["contrast", none]


@pytest.mark.parametrize(
    ("depth", "values", "words"), [(5.0, None, None), (np.nan, None, "nothing of the"), (5.0, np.nan, None)]
)
def test_a_picture_that_shows_something_is_not_empty(depth: float, values: float | None, words: str | None) -> None:
    def full(value: float) -> np.ndarray:
        return np.full((2, 2), value)

    picture: Any = SimpleNamespace(
        depth=full(depth), values=None if values is None else full(values), mode="surface", report={}
    )
    found = find_emptiness(picture)
    assert found is None if words is None else words in str(found)


def test_parts_without_figures_of_a_print_have_no_warnings() -> None:
    part: Any = SimpleNamespace(facts={}, name="")
    nothing: Any = None
    assert purposes.describe_purposes([part], MeshSettings(), nothing, nothing) == [] and part.facts == {"print": None}


@pytest.mark.parametrize(("name", "is_refused"), [("a.jpg", True), ("a.png", False)])
def test_some_pictures_hold_no_transparency(name: str, is_refused: bool, tmp_path: Any) -> None:
    settings = RenderSettings(background="transparent")
    if is_refused:
        with refused(UsageError, "JPG", "background"):
            check_pictures(PictureFiles(str(tmp_path / name)), settings)
    else:
        check_pictures(PictureFiles(str(tmp_path / name)), settings)


def test_a_turntable_needs_a_file_and_a_turn(tmp_path: Any) -> None:
    with pytest.raises(UsageError, match="a turntable needs both"):
        make_pictures("a", PictureFiles(turntable=str(tmp_path / "a.gif")), RenderSettings())
