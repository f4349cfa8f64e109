"""Records: frozen dataclasses with typed fields that are dicts too, as reports in JSON need."""

from __future__ import annotations

import copy
import json
from dataclasses import FrozenInstanceError, dataclass, fields
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from house import package_modules
from refusals import refused

from clrecon.anatomy.iso_choice import IsoChoice
from clrecon.anatomy.spine_line import SpineLine
from clrecon.geometry.certificate import Certificate, amend
from clrecon.labels.statistics import LabelFigures
from clrecon.mesh.quality import MeshQuality
from clrecon.reading.common.source_facts import SeriesEntry, SeriesListing
from clrecon.spine.split import Vertebra, VertebraSplit
from clrecon.system.records import Gate, Record, at_most, describe_volume


@dataclass(frozen=True, eq=False)
class Pair(Record):
    """A record whose last field is no entry while it is None."""

    low: float
    inner: Gate | None = None
    note: str | None = None
    _LEFT_OUT = ("note",)


GATE = at_most("gap", measured=1.0, bound=2.0, unit="mm", subject="a gap")
CERTIFICATE = Certificate(
    format="DICOM", series={"number": 1}, slices=2, shape_ijk=[4, 3, 2], spacing_mm=[1.0] * 3, extent_mm=None,
    affine_ijk_to_lps_mm=None, orientation=None, tilt_deg=0.0, gap_mm={"min": 1.0}, transfer_syntax_names=[],
    rescale={}, files={}, gates=[GATE], warnings=["doubtful"],
)  # fmt: skip


def test_field_of_a_record_is_an_attribute_and_an_entry() -> None:
    pair = Pair(1.0, GATE)
    assert pair.inner is pair["inner"] is GATE


def test_entries_of_a_record_are_its_fields_in_their_order_without_those_left_out() -> None:
    assert list(Pair(1.0, GATE)) == ["low", "inner"]
    assert list(Pair(1.0, GATE, "a note")) == ["low", "inner", "note"]


def test_record_equals_a_dict_of_its_entries() -> None:
    assert Pair(1.0, GATE) == {"low": 1.0, "inner": dict(GATE)}


def test_record_is_written_to_json_as_its_dict() -> None:
    pair = Pair(1.0, GATE)
    assert json.loads(json.dumps(pair)) == pair.as_dict()


def test_record_is_unpacked_into_a_dict() -> None:
    pair = Pair(1.0, GATE)
    assert {**pair, "more": 1} == {"low": 1.0, "inner": GATE, "more": 1}


def test_repr_of_a_record_begins_with_its_class_and_fields() -> None:
    assert repr(GATE).startswith("Gate(name='gap', measured=1.0,")


@pytest.mark.parametrize(
    ("method", "arguments"),
    [
        ("__setitem__", ("low", 2.0)),
        ("update", ({"low": 2.0},)),
        ("pop", ("low",)),
        ("setdefault", ("more", 1)),
        ("__delitem__", ("low",)),
        ("__ior__", ({"low": 2.0},)),
        ("clear", ()),
        ("popitem", ()),
    ],
)
def test_change_of_an_entry_of_a_record_is_refused_with_its_class_and_as_dict(
    method: str, arguments: tuple[Any, ...]
) -> None:
    with refused(TypeError, "Pair", "as_dict"):
        getattr(Pair(1.0, GATE), method)(*arguments)


def test_change_of_a_field_of_a_record_is_refused() -> None:
    pair = Pair(1.0, GATE)
    with pytest.raises(FrozenInstanceError):
        pair.low = 2.0  # type: ignore[misc]
    assert pair.low == 1.0


def test_dict_of_a_record_and_of_records_in_it_can_be_changed_without_changing_them() -> None:
    plain = Pair(1.0, GATE).as_dict()
    assert type(plain) is type(plain["inner"]) is dict
    plain["inner"]["ok"] = "changed"
    assert GATE.ok is True


def test_changed_record_has_the_new_field_and_the_others() -> None:
    assert Pair(1.0, GATE).changed(low=3.0) == {"low": 3.0, "inner": GATE}


@pytest.mark.parametrize("copy_by", [copy.copy, copy.deepcopy])
def test_copy_of_a_record_has_the_classes_and_values_of_its_records(copy_by: Any) -> None:
    copied = copy_by(CERTIFICATE)
    assert type(copied) is Certificate
    assert type(copied.gates[0]) is Gate
    assert copied == CERTIFICATE


@pytest.mark.parametrize(("copy_by", "is_shared"), [(copy.copy, True), (copy.deepcopy, False)])
def test_only_a_shallow_copy_of_a_record_shares_its_lists(copy_by: Any, is_shared: bool) -> None:
    assert (copy_by(CERTIFICATE).warnings is CERTIFICATE.warnings) == is_shared


def test_amended_certificate_has_the_new_field_and_the_original_keeps_its_own() -> None:
    amended = amend(CERTIFICATE, warnings=[])
    assert isinstance(amended, Certificate)
    assert amended.warnings == amended["warnings"] == []
    assert CERTIFICATE.warnings == ["doubtful"]


def test_masks_amended_to_a_certificate_are_its_last_entries_in_the_order_of_masking() -> None:
    table = amend(CERTIFICATE, remove_table={"air_hu": -1000.0})
    both = amend(table, field_of_view={"radius_mm": 9.0})
    assert list(both)[-3:] == ["problems", "remove_table", "field_of_view"]
    assert both["field_of_view"] == both.masked["field_of_view"] == {"radius_mm": 9.0}
    assert "masked" not in both  # its entries stand for it


def test_plain_report_is_amended_in_a_copy() -> None:
    plain = {"warnings": ["own"]}
    assert amend(plain, remove_table={}) == {"warnings": ["own"], "remove_table": {}}
    assert plain == {"warnings": ["own"]}


def test_certificate_of_a_grid_file_has_the_entries_of_one_of_dicom() -> None:
    assert CERTIFICATE.changed(format="NRRD") == {**CERTIFICATE, "format": "NRRD"}


def test_certificate_of_a_grid_file_has_its_entries_in_its_own_order() -> None:
    order = list(CERTIFICATE.changed(format="NRRD"))
    assert order[order.index("slices_missing") + 1] == "dropped"
    assert order[order.index("rescale") + 1 :][:3] == ["padding_share", "padding_hu", "hu_range"]


def all_records() -> list[type[Record]]:
    """The classes of records in all modules, those derived from others too."""
    for name in package_modules():
        if name.split(".")[1:2] not in (["cli"], ["__main__"]):
            import_module(name)
    found, new = [], [Record]
    while new:
        new = [kind for parent in new for kind in parent.__subclasses__() if kind.__module__.startswith("clrecon.")]
        found += new
    return found


def test_every_class_of_records_compares_as_a_dict() -> None:
    kinds = all_records()
    assert {Certificate, Gate} <= set(kinds)
    for kind in kinds:
        assert kind.__eq__ is dict.__eq__, f"{kind.__name__} is made without eq=False"


LABEL_FIGURES = {
    "number": 28, "name": "vertebrae_L4", "voxels": 250_200, "ml": 39.09375, "label_ml": 39.09375000000001,
    "inside_share": 1.0, "unmeasured": 0, "mean_hu": 364.7322142286171, "sd_hu": 194.14300870016297, "min_hu": -69.0,
    "max_hu": 1777.0, "percentiles_hu": dict.fromkeys("12345", 1.0),
}  # fmt: skip


def test_repr_of_a_record_of_many_fields_has_some_of_them_with_six_digits() -> None:
    shown = "LabelFigures(number=28, name='vertebrae_L4', ml=39.0938, mean_hu=364.732, sd_hu=194.143, ...)"
    assert repr(LabelFigures(**LABEL_FIGURES)) == shown


def test_record_of_many_fields_has_all_of_them_as_entries() -> None:
    assert set(LabelFigures(**LABEL_FIGURES)) == {*LABEL_FIGURES, "surface"}  # which has a default


@pytest.mark.parametrize(
    "kind",
    [Certificate, IsoChoice, LabelFigures, MeshQuality, SeriesEntry, SpineLine, Vertebra, VertebraSplit],
    ids=lambda kind: kind.__name__,
)
def test_repr_of_a_record_of_many_fields_is_one_line_of_less_than_120_characters(kind: Any) -> None:
    record = kind.__new__(kind)
    vars(record).update(dict.fromkeys((field.name for field in fields(kind)), 12345.678), points=np.zeros((2, 3)))
    assert "\n" not in repr(record)
    assert len(repr(record)) < 120


def test_repr_of_a_listing_of_series_has_its_counts_alone() -> None:
    listing = SeriesListing(["x" * 999] * 3, chosen=2, skipped={}, warnings=[])
    assert repr(listing) == "SeriesListing(3 series, chosen=2, 0 warnings)"


@pytest.mark.parametrize(
    ("tilt_deg", "words"), [(0.04, ""), (-0.05, ", tilt -0.05 degrees")], ids=["rounding of headers", "tilt"]
)
def test_volume_is_described_with_its_tilt_from_a_twentieth_of_a_degree_on(tilt_deg: float, words: str) -> None:
    assert describe_volume({"shape_ijk": [4, 3, 2], "tilt_deg": tilt_deg}) == f"2 slices of 4 x 3{words}"
