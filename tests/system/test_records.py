"""Records: dataclasses with typed fields that are still the dicts which they used to be."""

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
from clrecon.system.records import Gate, Record, at_most


@dataclass(frozen=True, eq=False)
class Pair(Record):
    """For these tests."""

    low: float
    inner: Gate | None = None
    told: str | None = None
    _LEFT_OUT = ("told",)


GATE = at_most("gap", 1.0, 2.0, "mm", "a gap")
CERTIFICATE = Certificate(
    format="DICOM", series={"number": 1}, slices=2, shape_ijk=[4, 3, 2], spacing_mm=[1.0] * 3, extent_mm=None,
    affine_ijk_to_lps_mm=None, orientation=None, tilt_deg=0.0, gap_mm={"min": 1.0}, transfer_syntax_names=[],
    rescale={}, files={}, gates=[GATE], warnings=["doubtful"],
)  # fmt: skip


def test_fields_are_entries_in_their_order() -> None:
    pair = Pair(1.0, GATE)
    assert pair.inner is pair["inner"] is GATE
    assert list(pair) == ["low", "inner"]
    assert list(Pair(1.0, None, "more")) == ["low", "inner", "told"]
    assert pair == {"low": 1.0, "inner": dict(GATE)}
    assert json.loads(json.dumps(pair)) == pair.as_dict()
    assert {**pair, "more": 1} == dict(pair) | {"more": 1}
    assert repr(GATE).startswith("Gate(name='gap', measured=1.0,")


def test_a_record_cannot_be_changed_and_its_dict_can() -> None:
    pair = Pair(1.0, GATE)
    for change in (
        lambda: pair.__setitem__("low", 2.0),
        lambda: pair.update(low=2.0),
        lambda: pair.pop("low"),
        lambda: pair.setdefault("more", 1),
        lambda: pair.__delitem__("low"),
        lambda: pair.__ior__({"low": 2.0}),
        pair.clear,
        pair.popitem,
    ):
        with refused(TypeError, "Pair", "as_dict"):
            change()
    with pytest.raises(FrozenInstanceError):
        pair.low = 2.0  # type: ignore[misc]
    plain = pair.as_dict()
    plain["inner"]["ok"] = "changed"
    assert type(plain) is type(plain["inner"]) is dict
    assert GATE.ok is True
    assert pair.changed(low=3.0) == {"low": 3.0, "inner": GATE}


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy])
def test_copies_of_records_are_records(way: Any) -> None:
    copied = way(CERTIFICATE)
    assert type(copied) is Certificate
    assert copied == CERTIFICATE
    assert type(copied.gates[0]) is Gate
    assert (copied.warnings is CERTIFICATE.warnings) is (way is copy.copy)


def test_a_certificate_is_amended_by_field_and_by_mask() -> None:
    masked = amend(CERTIFICATE, warnings=[], remove_table={"air_hu": -1000.0})
    masked = amend(masked, field_of_view={"radius_mm": 9.0})
    assert isinstance(masked, Certificate)
    assert masked.warnings == [] == masked["warnings"]
    assert list(masked)[-3:] == ["problems", "remove_table", "field_of_view"]
    assert masked["field_of_view"] == masked.masked["field_of_view"] == {"radius_mm": 9.0}
    assert CERTIFICATE.warnings == ["doubtful"]
    assert "masked" not in masked
    plain = {"warnings": ["own"]}
    assert amend(plain, remove_table={}) == {"warnings": ["own"], "remove_table": {}}
    assert plain == {"warnings": ["own"]}


def test_the_entries_of_other_formats_keep_their_order() -> None:
    other = CERTIFICATE.changed(format="NRRD")
    assert set(other) == set(CERTIFICATE)
    order = list(other)
    assert order[order.index("slices_missing") + 1] == "dropped"
    assert order[order.index("rescale") + 1 :][:3] == ["padding_share", "padding_hu", "hu_range"]
    assert other == {**CERTIFICATE, "format": "NRRD"}


def all_records() -> list[type[Record]]:
    for name in package_modules():
        if name.split(".")[1:2] not in (["cli"], ["__main__"]):
            import_module(name)
    found, new = [], [Record]
    while new:
        new = [kind for parent in new for kind in parent.__subclasses__() if kind.__module__.startswith("clrecon.")]
        found += new
    return found


def test_every_record_compares_as_a_dict() -> None:
    kinds = all_records()
    assert {Certificate, Gate} <= set(kinds)
    for kind in kinds:
        assert kind.__eq__ is dict.__eq__, f"{kind.__name__} is made without eq=False"


def test_a_record_of_many_fields_shows_some_in_one_line_and_has_all_as_entries() -> None:
    figures = LabelFigures(
        number=28, name="vertebrae_L4", voxels=250_200, ml=39.09375, label_ml=39.09375000000001, inside_share=1.0,
        unmeasured=0, mean_hu=364.7322142286171, sd_hu=194.14300870016297, min_hu=-69.0, max_hu=1777.0,
        percentiles_hu=dict.fromkeys("12345", 1.0),
    )  # fmt: skip
    shown = "LabelFigures(number=28, name='vertebrae_L4', ml=39.0938, mean_hu=364.732, sd_hu=194.143, ...)"
    assert repr(figures) == shown
    assert len(figures) == 13  # the twelve above, and the warnings


@pytest.mark.parametrize(
    "kind",
    [Certificate, IsoChoice, LabelFigures, MeshQuality, SeriesEntry, SpineLine, Vertebra, VertebraSplit],
    ids=lambda kind: kind.__name__,
)
def test_every_large_record_is_shown_in_one_short_line(kind: Any) -> None:
    record = kind.__new__(kind)
    vars(record).update(dict.fromkeys((field.name for field in fields(kind)), 12345.678), points=np.zeros((2, 3)))
    assert len(repr(record)) < 120 and "\n" not in repr(record)


def test_a_listing_is_shown_by_its_counts() -> None:
    listing = SeriesListing(["x" * 999] * 3, 2, {}, [])
    assert repr(listing) == "SeriesListing(3 series, chosen=2, 0 warnings)"
