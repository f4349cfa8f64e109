"""The trap matrix: CT series that readers place wrongly, each with its truth in mm and what clrecon must do with it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from dicom_series import ROOT, Change, rotation, set_raw, set_values
from enhanced_image import save_enhanced
from pydicom.dataset import Dataset
from trap_bytes import add_byte_cases
from trap_figures import add_figure_cases
from trap_mixtures import add_mixture_cases
from trap_plan import CASES, FOREIGN_HU, GAP_MM, OBLIQUE, REFUSED, WARNED, Marks, Size, plan_for, write_slices
from trap_plan import add_case as _case
from trap_plan import add_simple as _simple


def _both(*changes: Change) -> Change:
    def change(ds: Dataset, k: int) -> None:
        for one in changes:
            one(ds, k)

    return change


def _another_image(**values: Any) -> Change:
    """A change for a second set of images in the same series: SOPInstanceUIDs of their own."""

    def change(ds: Dataset, k: int) -> None:
        ds.SOPInstanceUID = f"{ds.SOPInstanceUID}.2"
        for keyword, value in values.items():
            setattr(ds, keyword, value)

    return change


# --- one affine, exactly ---
_simple("regular, non-square pixels")
_simple("axial", plan={"angles": (0, 0, 0)})
_simple("sagittal", plan={"angles": (0, 90, 90)})
_simple("coronal", plan={"angles": (-90, 0, 0)})
_simple("feet first", plan={"angles": (0, 180, 0)}, change=set_values(PatientPosition="FFS"))
_simple("prone", plan={"angles": (0, 0, 180)}, change=set_values(PatientPosition="HFP"))
_simple("slice normal towards the feet", plan={"angles": (180, 0, 0)})
_simple("file names in reverse order, wrong InstanceNumber", plan={"name": lambda k: f"{900 - k}"}, change=(
    lambda ds, k: setattr(ds, "InstanceNumber", (7 * k) % 23)
))  # fmt: skip
for degrees in (1.0, 2.5, 12.0, -20.0):
    _simple(f"tilt {degrees:g} deg", WARNED, (f"{abs(degrees):.2f} degrees",), plan={"tilt_deg": degrees})
_simple("tilt 12 deg, axial", WARNED, ("12.00 degrees: kept exactly",), plan={"tilt_deg": 12.0, "angles": (0, 0, 0)})
_simple("coordinates of 1e5 mm", plan={"origin": (1e5, -1e5, 9.9e4), "decimals": 6}, bound="far")
_simple("0.625 mm rounded to 0.01 mm", plan={"gap": 0.625, "decimals": 2, "angles": (0, 0, 0)}, bound="rounded")
_simple(
    "SliceThickness 5, SpacingBetweenSlices -5",
    WARNED,
    ("SpacingBetweenSlices says -5 mm, the positions say 1.25 mm",),
    change=set_values(SpacingBetweenSlices=-5),
)


@_case("the last slice lost")
def _last_lost(folder: Path, size: Size) -> Marks:
    return write_slices(folder, plan_for(size, leave_out=(size.slices - 1,)))


@_case("slices that step sideways", WARNED, ("12.00 degrees: kept exactly",))
def _sideways(folder: Path, size: Size) -> Marks:
    plan = plan_for(size)
    row = plan.directions[0]

    def change(ds: Dataset, k: int) -> None:
        shift = k * GAP_MM * np.tan(np.radians(12.0)) * row
        ds.ImagePositionPatient = [round(float(v), 9) for v in plan.position(k) + shift]

    marks = write_slices(folder, plan, change=change)
    k = np.repeat(np.arange(size.slices), 4)[:, None]
    return replace(marks, lps_mm=marks.lps_mm + k * GAP_MM * np.tan(np.radians(12.0)) * row)


@_case("0.001 deg jitter of the orientation", bound="jitter")
def _jitter(folder: Path, size: Size) -> Marks:
    def change(ds: Dataset, k: int) -> None:
        turned = rotation(OBLIQUE) @ rotation((0.0, 0.0, 0.001 * (-1) ** k))
        ds.ImageOrientationPatient = [round(float(v), 9) for v in (*turned[:, 0], *turned[:, 1])]

    return write_slices(folder, plan_for(size), change=change)


# --- uneven stacks and holes ---
@_case("gap 1.25 then 2.5 mm", WARNED, ("1.250", "2.500"))
def _feed(folder: Path, size: Size) -> Marks:
    half = size.slices // 2
    return write_slices(folder, plan_for(size, offsets={k: GAP_MM * (k - half) for k in range(half + 1, size.slices)}))


@_case("gap 1.25 then 2.5 mm, tilt 12 deg", WARNED, ("12.00 degrees: kept exactly", "2.500"))
def _tilted_feed(folder: Path, size: Size) -> Marks:
    half = size.slices // 2
    offsets = {k: GAP_MM * (k - half) for k in range(half + 1, size.slices)}
    return write_slices(folder, plan_for(size, offsets=offsets, tilt_deg=12.0))


@_case("one step off by 0.15 mm", WARNED, ("1.250", "1.400"))
def _one_step(folder: Path, size: Size) -> Marks:
    return write_slices(folder, plan_for(size, offsets=dict.fromkeys(range(size.slices // 2, size.slices), 0.15)))


@_case("one slice off by 0.15 mm", WARNED, ("1.100", "1.400"))
def _one_off(folder: Path, size: Size) -> Marks:
    return write_slices(folder, plan_for(size, offsets={size.slices // 2: 0.15}))


@_case("+0.19 mm per gap in the second half", WARNED, ("1.250", "1.440"))
def _drift(folder: Path, size: Size) -> Marks:
    half = size.slices // 2
    return write_slices(folder, plan_for(size, offsets={k: 0.19 * (k - half) for k in range(half + 1, size.slices)}))


def _lost(name: str, places: Callable[[int], tuple[int, ...]], *words: str) -> None:
    @_case(name, REFUSED, words, again={"allow_gaps": True}, again_words=words)
    def write(folder: Path, size: Size) -> Marks:
        return write_slices(folder, plan_for(size, leave_out=places(size.slices)))


_lost("one slice missing", lambda n: (n // 2,), "1 slice missing between", "gap 2.500 mm, usual 1.250 mm")
_lost("one slice missing at the end", lambda n: (n - 2,), "1 slice missing between")
_lost("one slice missing at the start", lambda n: (1,), "1 slice missing between")
_lost("two holes", lambda n: (n // 3, n // 2, n // 2 + 1), "1 slice missing between", "2 slices missing between")
_lost("two slabs, 12 slices apart", lambda n: tuple(range(n // 4, n // 4 + 12)), "12 slices missing between")


# --- more than one stack in a series ---
@_case("localizer in the same series")
def _localizer(folder: Path, size: Size) -> Marks:
    scout = plan_for(Size(1, size.rows, size.columns), angles=(0, 90, 90), first_hu=FOREIGN_HU)
    change = _another_image(ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    write_slices(folder, scout, change=change, prefix="scout")
    return write_slices(folder, plan_for(size))


@_case("localizer not marked as a localizer", WARNED, ("1 other CT series not used",))
def _silent_localizer(folder: Path, size: Size) -> Marks:
    scout = plan_for(Size(1, size.rows, size.columns), angles=(0, 90, 90), first_hu=FOREIGN_HU)
    write_slices(folder, scout, change=_another_image(), prefix="scout")
    return write_slices(folder, plan_for(size))


@_case("two orientations in one series", REFUSED, ("different directions", "axial", "choose one with series"))
def _two_orientations(folder: Path, size: Size) -> Marks:
    other = plan_for(Size(size.slices // 2, size.rows, size.columns), angles=(0, 90, 90), first_hu=FOREIGN_HU)
    write_slices(folder, other, change=_another_image(), prefix="other")
    return write_slices(folder, plan_for(size))


@_case("three discs, each with its own angle", REFUSED, ("one with series",))
def _discs(folder: Path, size: Size) -> Marks:
    third = Size(size.slices // 3, size.rows, size.columns)
    for disc in (2, 1, 0):
        plan = plan_for(third, angles=(15.0 * disc, 0, 0), first_hu=FOREIGN_HU * disc + 1)

        def number(ds: Dataset, k: int, disc: int = disc) -> None:
            ds.SOPInstanceUID = f"{ROOT}.5.{disc + 1}.{k + 1}"

        marks = write_slices(folder, plan, change=number, prefix=f"disc{disc}")
    return marks


@_case("two FrameOfReferenceUIDs", REFUSED, ("FrameOfReferenceUID differ",))
def _two_frames(folder: Path, size: Size) -> Marks:
    def change(ds: Dataset, k: int) -> None:
        if k >= size.slices // 2:
            ds.FrameOfReferenceUID = f"{ROOT}.98"

    marks = write_slices(folder, plan_for(size), change=change)
    marks.lps_mm[4 * (size.slices // 2) :] = np.nan
    return marks


@_case("orientation turns by 0.5 deg over the stack", REFUSED, ("ImageOrientationPatient differs within the series",))
def _turning(folder: Path, size: Size) -> Marks:
    plan = plan_for(size)
    truth = plan.marks()

    def change(ds: Dataset, k: int) -> None:
        turned = rotation(OBLIQUE) @ rotation((0.5 * k / (size.slices - 1), 0.0, 0.0))
        ds.ImageOrientationPatient = [round(float(v), 9) for v in (*turned[:, 0], *turned[:, 1])]
        for corner, (i, j) in enumerate(plan.corners()):
            truth.lps_mm[4 * k + corner] = plan.position(k) + 0.5 * i * turned[:, 0] + 0.7 * j * turned[:, 1]

    write_slices(folder, plan, change=change)
    return truth


@_case("PixelSpacing changes half way", REFUSED, ("PixelSpacing differs within the series",))
def _two_spacings(folder: Path, size: Size) -> Marks:
    wide = plan_for(size, pixel_spacing=(0.8, 0.6))

    def change(ds: Dataset, k: int) -> None:
        if k >= size.slices // 2:
            ds.PixelSpacing = list(wide.pixel_spacing)

    marks = write_slices(folder, plan_for(size), change=change)
    marks.lps_mm[4 * (size.slices // 2) :] = wide.marks().lps_mm[4 * (size.slices // 2) :]
    return marks


@_case("two series of the same length", REFUSED, ("one with series",), again={"series": 1})
def _two_series(folder: Path, size: Size) -> Marks:
    marks = write_slices(folder, plan_for(size))
    other = plan_for(size, series=2, first_hu=FOREIGN_HU, origin=(40.0, 31.0, -300.0))
    write_slices(folder, other, change=None, prefix="other")
    return marks


# --- several images at one position ---
def _copies(name: str, change: Change | None) -> None:
    @_case(name, WARNED, ("duplicate slices dropped: same place, same pixels",))
    def write(folder: Path, size: Size) -> Marks:
        marks = write_slices(folder, plan_for(size))
        if change is None:
            for file in sorted(folder.iterdir()):
                shutil.copy(file, folder / f"copy{file.name}")
        else:
            write_slices(folder, plan_for(size), change=change, prefix="again")
        return marks


_copies("every file twice", None)
_copies("every slice twice, equal pixels", _another_image())


def _phases(name: str, words: tuple[str, ...], **second: Any) -> None:
    @_case(name, REFUSED, ("one with phase", *words), again={"phase": 1})
    def write(folder: Path, size: Size) -> Marks:
        first = {keyword: value[0] for keyword, value in second.items()}
        last = {keyword: value[1] for keyword, value in second.items()}
        marks = write_slices(folder, plan_for(size), change=set_values(**first))
        write_slices(folder, plan_for(size, first_hu=FOREIGN_HU), change=_another_image(**last), prefix="p")
        return marks


_phases("two phases by acquisition", ("AcquisitionNumber",), AcquisitionNumber=(1, 2))
_phases("two phases by time", ("AcquisitionTime",), AcquisitionTime=("120000", "120030"))
_phases("two cardiac phases", ("TriggerTime",), TriggerTime=("100", "500"))
_phases("two recon kernels", ("ConvolutionKernel",), ConvolutionKernel=("B30f", "B70f"))


@_case("one slice twice, other pixels", REFUSED, ("parts them into phases",))
def _one_differs(folder: Path, size: Size) -> Marks:
    marks = write_slices(folder, plan_for(size))
    others = plan_for(size, first_hu=FOREIGN_HU, leave_out=tuple(k for k in range(size.slices) if k != 5))
    write_slices(folder, others, change=_another_image(), prefix="again")
    return marks


@_case(
    "two phases, a slice of the second missing",
    REFUSED,
    ("one with phase",),
    again={"phase": 1},
    again_words=("phase 1 of 2",),
)
def _phase_with_a_hole(folder: Path, size: Size) -> Marks:
    marks = write_slices(folder, plan_for(size), change=set_values(AcquisitionNumber=1))
    second = plan_for(size, first_hu=FOREIGN_HU, leave_out=(size.slices // 2,))
    write_slices(folder, second, change=_another_image(AcquisitionNumber=2), prefix="p")
    return marks


# --- headers ---
@_case("a slice without its position", REFUSED, ("ImagePositionPatient (0020,0032) is missing or empty",))
def _no_position(folder: Path, size: Size) -> Marks:
    change = set_values(only=size.slices // 2, ImagePositionPatient=None)
    return write_slices(folder, plan_for(size), change=change)


_simple(
    "orientation of zeros",
    REFUSED,
    ("ImageOrientationPatient (0020,0037)",),
    change=set_raw("ImageOrientationPatient", "0\\0\\0\\0\\0\\0"),
)
_simple(
    "PixelSpacing with decimal commas",
    REFUSED,
    ("PixelSpacing (0028,0030) is '0,7\\0,5'",),
    change=set_raw("PixelSpacing", "0,7\\0,5"),
)
_simple("slopes 1, 2, 3, 4 slice by slice", plan={"slopes": (1, 2, 3, 4)})


# --- multi-frame ---
def _enhanced(name: str, **kw: Any) -> None:
    options = {key: kw.pop(key) for key in ("order", "plan") if key in kw}

    @_case(name, **kw)
    def write(folder: Path, size: Size) -> Marks:
        plan = plan_for(size, slopes=(1, 2, 3, 4), **options.get("plan", {}))
        order = [(k * 7 + 3) % size.slices for k in range(size.slices)] if options.get("order") else None
        save_enhanced(folder / "enhanced.dcm", plan, order=order)
        return plan.marks()


_enhanced("enhanced CT, slopes 1, 2, 3, 4")
_enhanced("enhanced CT, frames unsorted", order=True)
_enhanced("enhanced CT, tilt 12 deg", plan={"tilt_deg": 12.0}, verdict=WARNED, words=("12.00 degrees: kept exactly",))


# --- what looks right and is not ---
_placed = set(CASES)
add_mixture_cases()
add_byte_cases()
add_figure_cases()
for _name in CASES.keys() - _placed:
    CASES[_name] = replace(CASES[_name], looks_right=True)
