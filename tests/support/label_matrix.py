"""The matrix of label maps and volumes: files with known places and contents, and what must come of each.

A row is read whole and compared with what was written: the voxels bit for bit, the places at the corners in mm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dicom_series
import numpy as np
from label_files import OBLIQUE, RAS, ct_slices, make_labels, write_nifti, write_nrrd, write_seg
from structure_sets import write_structures
from volume_files import LEFT_HANDED, ROTATED, WRITERS, make_ct, write_metaimage

from clrecon import LabelMap, Volume, read_labels, read_volume
from clrecon.errors import ClreconError

EXACT, WARNED, REFUSED = "exact", "exact+warning", "refused"
PLACE_MM = 1e-9
FLOAT32_MM = 2e-5
"""Half a unit of float32 of a sform at some 100 mm, at the corner of a small volume."""

STRAIGHT = np.array([[0.7, 0.0, 0.0, -25.0], [0.0, 0.5, 0.0, -30.0], [0.0, 0.0, 2.5, -84.0], [0.0, 0.0, 0.0, 1.0]])
PLACES = {"straight": STRAIGHT, "oblique": ROTATED, "left-handed": LEFT_HANDED, "sheared": OBLIQUE}
KINDS: dict[str, Callable[..., np.ndarray]] = {"label map": make_labels, "volume": make_ct}


def measure_place(found: LabelMap | Volume, voxels: np.ndarray, affine: np.ndarray) -> float:
    """Return the largest distance of a corner from its place in mm, infinity where the voxels are others."""
    if not np.array_equal(found.voxels, voxels):
        return float("inf")
    nk, nj, ni = voxels.shape
    corners = np.array([[i, j, k, 1.0] for i in (0, ni - 1) for j in (0, nj - 1) for k in (0, nk - 1)])
    return float(np.linalg.norm(corners @ (found.affine - affine).T, axis=1).max())


def read_back(name: str, place: str, kind: str, folder: Path) -> float:
    """Write a file of a format at a place, read it, and return the largest error in mm."""
    voxels = KINDS[kind]()
    path = WRITERS[name](folder / name, voxels, PLACES[place])
    return measure_place(read_labels(path) if kind == "label map" else read_volume(path), voxels, PLACES[place])


def table_of_places() -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of the table of formats, from `expected_mm`."""
    rows = [
        [f"`{name}`", *("exact" if expected_mm(name) == PLACE_MM else "float32" for _ in PLACES)] for name in WRITERS
    ]
    return ["file, as label map and as volume", *PLACES], rows


def expected_mm(name: str) -> float:
    """Return how exact the places of a format are: a sform of NIfTI is float32, of NIfTI-2 float64."""
    return FLOAT32_MM if name in ("a.nii", "a.nii.gz", "a.hdr") else PLACE_MM


@dataclass(frozen=True)
class Row:
    """A file that is odd.

    write: Writes the file into a folder; returns the map that is read and the voxels that it must have.
    verdict: exact, exact+warning or refused.
    words: What the warning or the refusal must hold.
    file: Writes the file alone: its path, and voxels and affine that it would have if it were not odd.
    """

    name: str
    write: Callable[[Path], tuple[LabelMap, np.ndarray]]
    verdict: str = EXACT
    words: str = ""
    file: Callable[[Path], tuple[Path, np.ndarray, np.ndarray]] | None = None


ROWS: list[Row] = []


def add_grid(name: str, verdict: str, words: str, file: Callable[[Path], tuple[Path, np.ndarray, np.ndarray]]) -> None:
    """Add a row for a label map that `file` writes."""

    def write(folder: Path) -> tuple[LabelMap, np.ndarray]:
        path, voxels, _ = file(folder)
        return read_labels(path), voxels

    ROWS.append(Row(name, write, verdict, words, file))


def judge(case: Row, folder: Path) -> tuple[str, str]:
    """Return the verdict about a row, and what was said."""
    try:
        found, voxels = case.write(folder)
    except ClreconError as error:
        return REFUSED, str(error)
    if not np.array_equal(found.voxels, voxels):
        return "wrong", ""
    return (WARNED, "; ".join(found.warnings)) if found.warnings else (EXACT, "")


def table_of_rows() -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of the table of odd files."""
    return ["file", "clrecon", "says"], [[case.name, case.verdict, case.words] for case in ROWS]


# --- NIfTI ---------------------------------------------------------------------------------------------------------

FIELDS = {"dim0": (40, "<i2"), "dim4": (48, "<i2"), "code": (70, "<i2"), "qfac": (76, "<f4"), "di": (80, "<f4"),
          "slope": (112, "<f4"), "units": (123, "u1"), "sform": (254, "<i2"), "qx": (268, "<f4"),
          "magic": (344, "S4")}  # fmt: skip


def add_nifti(
    name: str,
    verdict: str = EXACT,
    words: str = "",
    *,
    voxels: np.ndarray | None = None,
    wanted: np.ndarray | None = None,
    fields: dict[str, Any] | None = None,
    **options: Any,
) -> None:
    voxels = make_labels() if voxels is None else voxels

    def file(folder: Path) -> tuple[Path, np.ndarray, np.ndarray]:
        path = write_nifti(folder / "a.nii", voxels, STRAIGHT, **options)
        content = bytearray(path.read_bytes())
        for field, value in (fields or {}).items():
            offset, dtype = FIELDS[field]
            stored = np.array([value], dtype).tobytes()
            content[offset : offset + len(stored)] = stored
        path.write_bytes(content)
        return path, voxels if wanted is None else wanted, STRAIGHT

    add_grid(f"NIfTI, {name}", verdict, words, file)


add_nifti("pixdim[0] = 0 with a qform alone", sform=False, qform=True, fields={"qfac": 0})
add_nifti("pixdim[0] = 3 beside a sform", WARNED, "its qform cannot be read", qform=True, fields={"qfac": 3})
add_nifti("pixdim[0] = 3, a qform alone", REFUSED, "corrupt NIfTI header", sform=False, qform=True, fields={"qfac": 3})
add_nifti("neither sform nor qform", REFUSED, "does not say where it lies", sform=False)
add_nifti("sform and qform apart", WARNED, "sform and qform lie 4 mm apart", qform=True, fields={"qx": 29.0})
add_nifti("pixdim other than the sform", WARNED, "pixdim says a spacing of", fields={"di": 0.9})
add_nifti("lengths in unknown units", REFUSED, "has lengths in unknown units", fields={"units": 7})
add_nifti("fractions", REFUSED, "is not a label map", voxels=make_labels() * 0.5, dtype="f4")
add_nifti("whole numbers as float64", dtype="f8")
add_nifti("negative numbers", REFUSED, "labels run from 0 to 65,535", voxels=make_labels().astype("i2") - 3)
add_nifti("numbers above 65,535", REFUSED, "labels run from 0 to 65,535", voxels=make_labels().astype("i4") * 30_000)
add_nifti("a slope of 2", wanted=make_labels() * 2, fields={"slope": 2})
add_nifti("four axes", REFUSED, "has 4 axes", voxels=np.stack([make_labels(), make_labels()]))
add_nifti("four axes, the last of length 1", voxels=make_labels()[None], wanted=make_labels())
add_nifti("colours", REFUSED, "its voxels are colours", fields={"code": 128})
add_nifti("Analyze", REFUSED, "Analyze files do not say where they lie", fields={"magic": b"\0\0\0\0"})
add_nifti("no voxel with a label", REFUSED, "is empty: no voxel has a label", voxels=make_labels() * np.uint8(0))

# --- NRRD and MetaImage --------------------------------------------------------------------------------------------


def edit(path: Path, old: bytes, new: bytes) -> Path:
    """Put new bytes in the place of old ones, where these stand first."""
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return path


def add_text(name: str, file_name: str, old: bytes, new: bytes, verdict: str, words: str) -> None:
    """Add a row for a header in text, in which `new` stands in place of `old`."""
    write_file = write_metaimage if ".mh" in file_name else (lambda *args: write_nrrd(*args, encoding="raw"))

    def file(folder: Path) -> tuple[Path, np.ndarray, np.ndarray]:
        path = write_file(folder / file_name, make_labels(), STRAIGHT)
        return edit(path, old, new), make_labels(), STRAIGHT

    add_grid(name, verdict, words, file)


add_text(
    "NRRD without a frame", "a.nrrd", b"space: left-posterior-superior\n", b"", REFUSED, "does not say where it lies"
)
add_text("NRRD as text", "a.nrrd", b"encoding: raw", b"encoding: hex", REFUSED, "is stored as 'hex'")
add_text("NRRD with a gap", "a.nrrd", b"encoding: raw", b"encoding: raw\nbyte skip: 4", REFUSED, "says 'byte skip'")
add_text(
    "NRRD, quantised", "a.nrrd", b"encoding: raw", b"encoding: raw\nold min: 0", WARNED, "the values were quantised"
)
add_text(
    ".nhdr, voxels in another folder", "a.nhdr", b": a.raw", b": ../a.raw", REFUSED, "only files beside it are read"
)
add_text(".nhdr, voxels missing", "a.nhdr", b": a.raw", b": b.raw", REFUSED, "which is not there")
add_text(
    ".nhdr, one file per slice", "a.nhdr", b": a.raw", b": a.%02d.raw 0 3 1", REFUSED, "has its voxels in several files"
)
add_text("MetaImage without Offset", "a.mha", b"Offset", b"Comment", REFUSED, "it does not say where it lies")
add_text("MetaImage, spacing 0", "a.mha", b"ElementSpacing = 0.7", b"ElementSpacing = 0", REFUSED, "steps above 0 mm")
add_text(
    "MetaImage, two positions", "a.mha", b"Offset", b"Origin = 0 0 0\nOffset", REFUSED, "it says Offset and Origin"
)
add_text("MetaImage, text", "a.mha", b"BinaryData = True", b"BinaryData = False", REFUSED, "voxels written as text")
add_text(".mhd, voxels in another folder", "a.mhd", b"= a.raw", b"= ../a.raw", REFUSED, "only files beside it are read")
add_text(".mhd, one file per slice", "a.mhd", b"= a.raw", b"= LIST", REFUSED, "LOCAL or one file, not several")


def add_layers(
    name: str, verdict: str, words: str, *keys: dict[str, str], overlap: bool = False, only: Any = None
) -> None:
    def write(folder: Path) -> tuple[LabelMap, np.ndarray]:
        voxels = np.zeros((3, 4, 5, 2), np.uint8)
        voxels[0, 0, :2, 0] = voxels[0 if overlap else 1, 0, 1:4, 1] = 1
        fields = {key: value for each in keys for key, value in each.items()}
        found = read_labels(write_nrrd(folder / "a.seg.nrrd", voxels, STRAIGHT, **fields), only)
        return found, voxels[..., 0] if only else voxels[..., 0] + 2 * voxels[..., 1]

    ROWS.append(Row(f".seg.nrrd, {name}", write, verdict, words))


def segment(n: int, **keys: Any) -> dict[str, str]:
    return {f"Segment{n}_{key}": str(value) for key, value in {"Name": f"s{n}", **keys}.items()}


LAYERED = [segment(n, LabelValue=1, Layer=n) for n in (0, 1)]
add_layers("layers", EXACT, "", *LAYERED)
add_layers("layers that overlap", REFUSED, "share 1 voxels", *LAYERED, overlap=True)
add_layers("layers that overlap, only one read", EXACT, "", *LAYERED, overlap=True, only=["s0"])
add_layers("layers of 3D Slicer before 4.11", WARNED, "segment n is taken from layer n", segment(0), segment(1))
add_layers("layers to which no segment refers", REFUSED, "have no Layer", *(segment(n, LabelValue=1) for n in (0, 1)))
add_layers("values to which no segment refers", REFUSED, "have no LabelValue", *(segment(n, Layer=n) for n in (0, 1)))
add_layers("a layer that is not there", REFUSED, "is in layer 2", LAYERED[0], segment(1, LabelValue=1, Layer=2))
add_layers("layers without segments", REFUSED, "does not say which segments they hold")

# --- DICOM SEG -----------------------------------------------------------------------------------------------------

PLAN = dicom_series.Plan(shape=(6, 8, 9), angles=(10, -20, 35), gap=1.25)


def seg_masks(*, overlap: bool = False, second: int = 1) -> np.ndarray:
    """Masks (2, 6, 8, 9) of two segments in the first four slices, or in each `second` of them."""
    found = np.zeros((2, 6, 8, 9), bool)
    found[0, 0:4:second, 1:4, 2:7] = True
    found[1, 0:4:second, 3 if overlap else 4 : 7, 3:8] = True
    return found


def add_seg(
    name: str,
    verdict: str = EXACT,
    words: str = "",
    *,
    change: Callable[[Any], None] | None = None,
    plan: dicom_series.Plan = PLAN,
    kind: str = "BINARY",
    syntax: str | None = None,
    **masks: Any,
) -> None:
    def write(folder: Path) -> tuple[LabelMap, np.ndarray]:
        import pydicom

        from clrecon.labels import resample_labels

        found = seg_masks(**masks)
        path = write_seg(
            folder / "a.dcm", [("a", found[0]), ("b", found[1])], ct_slices(plan), kind=kind, syntax=syntax
        )
        if change is not None:
            ds = pydicom.dcmread(path)
            change(ds)
            ds.save_as(path)
        dicom_series.write_series(folder / "ct", plan)
        volume = read_volume(folder / "ct")
        labels = read_labels(path)
        taken = resample_labels(labels, volume)
        on_scan = LabelMap(taken.voxels, volume.affine, warnings=labels.warnings)
        return on_scan, found[0] + 2 * found[1].astype(np.uint8)

    ROWS.append(Row(f"DICOM SEG, {name}", write, verdict, words))


def unsay(*keywords: str) -> Callable[[Any], None]:
    def change(ds: Any) -> None:
        measures = ds.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0]
        for keyword in keywords:
            if keyword in measures:
                delattr(measures, keyword)

    return change


def add_frame(*, zeros: bool = False, number: int | None = None) -> Callable[[Any], None]:
    """Append a frame at the place of the first: of no pixels, or all of a number."""

    def change(ds: Any) -> None:
        pixels = ds.pixel_array.astype(np.uint8)
        extra = pixels[0] * 0 if zeros else np.where(pixels[0] > 0, number or 1, 0).astype(np.uint8)
        every = np.concatenate([pixels, extra[None]])
        groups = ds.PerFrameFunctionalGroupsSequence
        ds.PerFrameFunctionalGroupsSequence = [*groups, groups[0]]
        ds.NumberOfFrames = len(every)
        data = np.packbits(every.ravel(), bitorder="little") if ds.BitsAllocated == 1 else every
        ds.PixelData = data.tobytes() + b"\0" * (data.size % 2)

    return change


def second_thickness(ds: Any) -> None:
    unsay("SpacingBetweenSlices")(ds)
    ds.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SliceThickness = 1.25


RLE = "1.2.840.10008.1.2.5"
add_seg("binary")
add_seg("label map", kind="LABELMAP")
add_seg("label map, RLE", kind="LABELMAP", syntax=RLE)
add_seg("tilted gantry", plan=dicom_series.Plan(shape=(6, 8, 9), tilt_deg=15.0))
add_seg("frames on every second slice", second=2)
add_seg(
    "the same, SliceThickness alone", WARNED, "2.5 mm apart, its header says 1.25 mm", change=second_thickness, second=2
)
add_seg("no step and no thickness", WARNED, "says neither SpacingBetweenSlices nor SliceThickness",
        change=unsay("SpacingBetweenSlices", "SliceThickness"))  # fmt: skip
add_seg("segments that overlap", REFUSED, "share 16 voxels", overlap=True)
add_seg("a frame twice", change=add_frame(number=1))
add_seg("a frame twice, other pixels", REFUSED, "contradicts itself", change=add_frame(zeros=True))
add_seg("label map, an empty frame at one place", kind="LABELMAP", change=add_frame(zeros=True))
add_seg(
    "label map, two segments for a voxel", REFUSED, "contradicts itself", kind="LABELMAP", change=add_frame(number=2)
)
add_seg(
    "fractional", REFUSED, "fractional ones do not say", change=lambda ds: setattr(ds, "SegmentationType", "FRACTIONAL")
)
add_seg("frames without a description", REFUSED, "frames and", change=lambda ds: setattr(ds, "NumberOfFrames", 3))

# --- RTSTRUCT ------------------------------------------------------------------------------------------------------

CLOSED, XOR = "CLOSED_PLANAR", "CLOSEDPLANAR_XOR"
Box = tuple[int, int, int, int]


def add_rt(
    name: str,
    verdict: str = EXACT,
    words: str = "",
    *,
    boxes: Sequence[Box] = ((2, 2, 9, 9),),
    kind: str = CLOSED,
    fill: Callable[[np.ndarray, np.ndarray], np.ndarray] = np.logical_or,
    off_mm: float = 0.0,
    extra: Sequence[tuple[str, int]] = (),
    inset: float = 0.5,
    frame: str = "",
    tilt: float = 0.0,
) -> None:
    """A structure of boxes (i0, j0, i1, j1), both ends included, on slice 2 of a scan; `fill` joins them."""

    def write(folder: Path) -> tuple[LabelMap, np.ndarray]:
        plan = dicom_series.Plan(shape=(5, 20, 24), gap=3.0, tilt_deg=tilt, angles=(0, 0, 0) if tilt else (10, -20, 35))
        dicom_series.write_series(folder / "ct", plan)
        volume = read_volume(folder / "ct")
        normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
        normal /= np.linalg.norm(normal)
        contours, wanted = [], np.zeros((5, 20, 24), bool)
        for i0, j0, i1, j1 in boxes:
            left, right, top, bottom = i0 - inset, i1 + inset, j0 - inset, j1 + inset
            ends = [(left, top, 2), (right, top, 2), (right, bottom, 2), (left, bottom, 2)]
            points = volume.ijk_to_lps(ends) + off_mm * normal
            contours.append((kind, points))
            box = np.zeros_like(wanted)
            box[2, j0 : j1 + 1, i0 : i1 + 1] = True
            wanted = fill(wanted, box)
        contours += [(kind, contours[0][1][:count]) for kind, count in extra]
        contours = contours if boxes else [("POINT", volume.ijk_to_lps([(3, 3, 2)]))]
        path = write_structures(folder / "rt.dcm", {"x": contours}, frame=frame)
        found = read_labels(path, volume=volume)
        return found, wanted.astype(np.uint8) if inset else found.voxels  # rounding decides on centres of the outline

    ROWS.append(Row(f"RTSTRUCT, {name}", write, verdict, words))


CROSSED = ((2, 5, 14, 8), (6, 2, 9, 14))
add_rt("one contour")
add_rt("tilted gantry", tilt=12.0)
add_rt("a hole", boxes=((2, 2, 12, 12), (5, 5, 8, 8)), fill=np.logical_xor)
add_rt("a contour twice", WARNED, "written twice, each counts once", boxes=((2, 2, 9, 9), (2, 2, 9, 9)))
add_rt("contours that cross", WARNED, "contours cross on 1 slice and were united", boxes=CROSSED)
add_rt("contours that cross, CLOSEDPLANAR_XOR", boxes=CROSSED, kind=XOR, fill=np.logical_xor)
add_rt("a contour of two points beside", WARNED, "1 contour of fewer than 3 points left out", extra=[(CLOSED, 2)])
add_rt("an open contour beside", WARNED, "1 OPEN_PLANAR left out", extra=[("OPEN_PLANAR", 4)])
add_rt("points alone", REFUSED, "1 POINT left out", boxes=())
add_rt("0.29 mm off slices of 3 mm", WARNED, "lie up to 0.29 mm off their slices", off_mm=0.29)
add_rt("0.31 mm off slices of 3 mm", REFUSED, "lie between the slices of the scan", off_mm=0.31)
add_rt("through voxel centres, where rounding decides", WARNED, "run through voxel centres", inset=0.0)
add_rt("of another frame of reference", REFUSED, "belong to frame of reference", frame="1.2.3")

# --- folders of masks ----------------------------------------------------------------------------------------------


def add_folder(name: str, verdict: str = EXACT, words: str = "", *, last: Callable[[Path], Any] | None = None,
               second: slice = slice(2, 3), value: int = 1) -> None:  # fmt: skip
    def write(folder: Path) -> tuple[LabelMap, np.ndarray]:
        masks = folder / "masks"
        masks.mkdir()
        wanted = np.zeros((4, 6, 7), np.uint8)
        wanted[second], wanted[0:2] = 2, 1
        one, other = (np.zeros_like(wanted) for _ in range(2))
        one[0:2], other[second] = value, value
        write_nifti(masks / "a.nii.gz", one, STRAIGHT)
        write_nrrd(masks / "b.nrrd", other, RAS @ RAS @ STRAIGHT)
        if last is not None:
            last(masks)
        return read_labels(masks), wanted

    ROWS.append(Row(f"folder of masks, {name}", write, verdict, words))


add_folder("NIfTI and NRRD")
add_folder("values 0 and 255", value=255)
add_folder("masks that overlap", WARNED, "the masks overlap in 42 voxels", second=slice(1, 3))
add_folder("two grids", REFUSED, "lie on two grids",
           last=lambda path: write_nifti(path / "c.nii", make_labels() > 0, OBLIQUE, dtype="u1"))  # fmt: skip
add_folder("a label map among them", REFUSED, "holds several labels",
           last=lambda path: write_nifti(path / "c.nii", make_labels(), STRAIGHT))  # fmt: skip
add_folder("two masks of one name", REFUSED, "has two masks of one name",
           last=lambda path: write_nifti(path / "a.nii", make_labels(), STRAIGHT))  # fmt: skip
add_folder("DICOM among them", REFUSED, "is a folder with DICOM files",
           last=lambda path: dicom_series.write_series(path / "", dicom_series.Plan(shape=(2, 4, 5))))  # fmt: skip
add_folder("other files among them", last=lambda path: (path / "statistics.json").write_text("{}"))


def link_out(masks: Path) -> None:
    path = write_nifti(masks.parent / "c.nii", make_labels() > 0, STRAIGHT, dtype="u1")
    (masks / "c.nii").symlink_to(path)


add_folder("a link to another folder", REFUSED, "is a link out of it (c.nii)", last=link_out)
add_folder("a mask without voxels", WARNED, "1 of 3 masks holds no voxel: c",
           last=lambda path: write_nifti(path / "c.nii", np.zeros((4, 6, 7), np.uint8), STRAIGHT))  # fmt: skip
