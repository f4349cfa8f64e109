"""Region rules and steps of preprocessing: their forms, and what they refuse."""

from __future__ import annotations

import math
import re

import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.options import (
    FILTERS,
    MORPHOLOGY,
    PREPROCESS_FORMS,
    REGION_FORMS,
    PreprocessStep,
    RegionRule,
    parse_preprocess,
    parse_region_rules,
)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("box:-1,2,3.5,4,5,6", RegionRule("box", (-1.0, 2.0, 3.5, 4.0, 5.0, 6.0))),
        ("box:,2,3,,5,", RegionRule("box", (-math.inf, 2.0, 3.0, math.inf, 5.0, math.inf))),
        ("HU:200,", RegionRule("hu", (200.0, math.inf))),
        ("hu:100,100", RegionRule("hu", (100.0, 100.0))),
        ("label:spine.nii.gz:T12", RegionRule("label", path="spine.nii.gz", name="T12")),
        ("label:C:\\maps\\spine.nii:28", RegionRule("label", path="C:\\maps\\spine.nii", name="28")),
        ("mask:a/b:c.nrrd", RegionRule("mask", path="a/b:c.nrrd")),
        ("tube:30", RegionRule("tube", (30.0,))),
        ("tube:30:line.csv", RegionRule("tube", (30.0,), path="line.csv")),
    ],
)
def test_rule_of_a_region_is_read_with_its_numbers_file_and_label(text: str, rule: RegionRule) -> None:
    assert parse_region_rules(text) == (rule,)


def test_text_of_a_rule_names_its_file_without_folders() -> None:
    rules = parse_region_rules(["label:maps/of/spine.nii:T12", "box:,2,3,,5,", "tube:30:a\\b\\line.csv"])
    assert [str(rule) for rule in rules] == ["label:spine.nii:T12", "box:,2,3,,5,", "tube:30:line.csv"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not known"),
        ("ball:1,2,3", "is not known: the rules are"),
        ("box:1,2,3", "is not known"),
        ("box:1,2,3,4,5,six", "is not known"),
        ("box:2,1,3,4,5,6", "1 is not above 2"),
        ("box:1,1,3,4,5,6", "holds nothing"),
        ("box:nan,1,3,4,5,6", "finite"),
        ("hu:300,200", "holds nothing"),
        ("hu:200", "is not known"),
        ("label:spine.nii", "is not known"),
        ("mask:", "is not known"),
        ("tube:0", "above 0, not 0"),
        ("tube:-3", "above 0, not -3"),
        ("tube:inf", "finite"),
        ("seed:1,2,3", "grows within HU or labels"),
        ("seed:1,2,", "is not known"),
    ],
)
def test_rule_of_another_form_is_refused(text: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        parse_region_rules(text)


def test_preprocessing_steps_of_one_text_are_read_in_their_order() -> None:
    steps = parse_preprocess("bilateral, Open:1.5,level:250,fill,bilateral-2d:0.7:36,region,fill-slices")
    assert [str(step) for step in steps] == [
        "bilateral", "open:1.5", "level:250", "fill", "bilateral-2d:0.7:36", "region", "fill-slices",
    ]  # fmt: skip


def test_preprocessing_steps_of_several_texts_are_read_with_their_numbers() -> None:
    erode, dilate = parse_preprocess(["erode:1", "dilate:2"])
    assert erode == PreprocessStep("erode", (1.0,))
    assert dilate == PreprocessStep("dilate", (2.0,))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not known"),
        ("open", "'open' of preprocessing is not known: the steps are"),
        ("open:1,5", "'5'"),
        ("open:1:5", "is not known"),
        ("open:0", "above 0"),
        ("open:-1", "above 0"),
        ("open:nan", "is not known"),
        ("open:1.5mm", "is not known"),
        ("fill:3", "is not known"),
        ("level", "is not known"),
        ("bilateral:1:2:3", "is not known"),
        ("region,fill,region", "named twice"),
        ("sharpen", "is not known"),
        ("curvature-flow:2.5", "needs a whole number"),
    ],
)
def test_step_of_another_form_is_refused(text: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        parse_preprocess(text)


@pytest.mark.parametrize("name", [*FILTERS, *MORPHOLOGY, "level", "region"])
def test_help_of_preprocessing_names_every_step(name: str) -> None:
    assert re.search(rf"(?<![\w-]){name}(?![\w-])", PREPROCESS_FORMS)  # fill-slices does not name fill


@pytest.mark.parametrize("kind", ["box:", "hu:", "label:", "mask:", "seed:", "tube:"])
def test_help_of_regions_names_a_kind_of_rule(kind: str) -> None:
    assert kind in REGION_FORMS


def test_step_region_without_a_region_is_refused() -> None:
    with refused(UsageError, "none"):
        MeshSettings(preprocess="open:1,region")


@pytest.mark.parametrize(
    ("preprocess", "is_later"), [("open:1,region", True), (None, False)], ids=["as a step", "before all steps"]
)
def test_region_is_applied_at_its_step_or_first(preprocess: str | None, is_later: bool) -> None:
    assert MeshSettings(region=("tube:30",), preprocess=preprocess).region_later == is_later


def test_points_of_a_region_are_in_the_frame_of_the_output() -> None:
    assert MeshSettings(region=("tube:30",), space="ras").space_of_points == "ras"


def test_allowed_bone_loss_is_refused_where_nothing_takes_bone() -> None:
    with pytest.raises(UsageError, match="nothing takes any"):
        MeshSettings(allow_bone_loss=True)


def test_allowed_bone_loss_is_accepted_with_a_step_that_takes_bone() -> None:
    assert MeshSettings(allow_bone_loss=True, preprocess="erode:1").allow_bone_loss
