"""Harmed DICOM series: values of elements, bytes, and ends."""

from __future__ import annotations

import functools
import json
import random
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dicom_series import Plan, element_bytes, make_dataset
from hostile_bytes import (
    BLOBS,
    LENGTHS,
    NUMBERS,
    TAGS,
    TEXTS,
    UIDS,
    VRS,
    Seed,
    apply_changes,
    find_elements,
    make_phases,
    phantom_seeds,
    pydicom_seeds,
    save_bytes,
)
from pydicom.datadict import dictionary_VR, tag_for_keyword
from pydicom.uid import ExplicitVRLittleEndian
from trials import Answer, Trial, digest

from clrecon.geometry import Volume
from clrecon.reading import list_series, read_volume

GEOMETRY = (
    "ImagePositionPatient ImageOrientationPatient PixelSpacing SliceThickness SpacingBetweenSlices SliceLocation"
    " GantryDetectorTilt InstanceNumber SeriesInstanceUID StudyInstanceUID FrameOfReferenceUID SOPInstanceUID"
    " SOPClassUID PatientPosition ImageType Modality AcquisitionNumber AcquisitionTime TemporalPositionIndex"
    " SeriesNumber Rows Columns NumberOfFrames"
).split()
PIXELS = (
    "BitsAllocated BitsStored HighBit PixelRepresentation SamplesPerPixel PhotometricInterpretation"
    " PlanarConfiguration RescaleSlope RescaleIntercept RescaleType PixelPaddingValue PixelPaddingRangeLimit"
    " SmallestImagePixelValue LossyImageCompression BurnedInAnnotation"
).split()
ROUNDING_MM = 0.02
"""What a change of positions within their tolerance of 0.01 mm moves voxels at most, that of the fit included."""
COUNT = 6
"""Slices of the series whose values are harmed: enough that their neighbours contradict one that lies."""


def answer_of(volume: Volume) -> Answer:
    """What a volume is, by name."""
    certificate = volume.certificate
    content = {
        "shape": str(volume.voxels.shape),
        "affine": str(volume.affine.round(6).tolist()),
        "origins": str(volume.slice_origins().round(6).tolist()),
    }
    content |= {f"slice {k}": digest(voxels.copy()) for k, voxels in enumerate(volume.voxels)}
    warned = tuple(certificate.warnings) if certificate else ()
    return Answer(content, warned, repr(volume.report))


def write_files(folder: Path, files: Sequence[bytes]) -> None:
    """Write the files of a series, and nothing else, into a folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for k, data in enumerate(files):
        (folder / f"{k}").write_bytes(data)


def read(folder: Path, **options: Any) -> Answer:
    """Read and list; the listing must not raise anything foreign either."""
    listing = list_series(folder, force=options.get("force", False))
    answer = answer_of(read_volume(folder, **options))
    listed = repr([{**entry.as_dict(), "description": ""} for entry in listing.series])
    return Answer(answer.content, answer.warnings, answer.said + listed + repr(listing.warnings))


# --- values of elements ---
@functools.cache
def series() -> tuple[bytes, ...]:
    """The files of an even series."""
    plan = Plan(shape=(COUNT, 3, 4))
    return tuple(save_bytes(make_dataset(plan, k)) for k in range(COUNT))


def values_of(keyword: str, true: bytes) -> list[bytes]:
    """Bytes to put in the place of an element's value."""
    vr = dictionary_VR(tag_for_keyword(keyword) or 0)
    if "US" in vr:
        near = {value + d for value in (*(1 << bit for bit in range(17)), 0x7FFF) for d in (-2, -1, 0, 1, 2)}
        values = [struct.pack("<H", value) for value in sorted({*range(70), *near}) if 0 <= value <= 0xFFFF]
        return [*values, b"", b"\1", b"\1\0\1\0", b"\1\0\0\0\0\0\0\0"]
    values = [*TEXTS, *UIDS]
    parts = true.strip(b" \0").split(b"\\")
    for place, part in enumerate(parts):
        other = [b"", b"-" + part, part + b"0", part + b"e1", part + b"e-1", part[:-1], part.replace(b".", b",")]
        other += [part.replace(b".", b""), b" " + part + b" ", b"+" + part, part + b"\0", part[::-1], b"0", b"nan"]
        try:
            number = float(part)
        except ValueError:
            other += [part + b".1", part.lower(), part + b" ", part.upper()]
        else:
            for factor in (-1, 0.1, 0.5, 0.9, 0.99, 0.999, 1.000001, 1.001, 1.01, 1.1, 2, 10, 100, 1000, 1e9):
                other.append(f"{number * factor:.10g}".encode())
            for add in (-1000, -1, -0.1, -0.01, 0.001, 0.01, 0.1, 0.5, 1, 5, 1000):
                other.append(f"{number + add:.10g}".encode())
        values += [b"\\".join([*parts[:place], text, *parts[place + 1 :]]) for text in other]
    if len(parts) > 1:
        values += [b"\\".join(parts[::-1]), b"\\".join(parts[:-1]), b"\\".join([*parts, parts[0]])]
    return list(dict.fromkeys(values))


def put(data: bytes, keyword: str, value: bytes | None) -> bytes:
    """A file with an element's value in place of its own, None: without the element."""
    tag = tag_for_keyword(keyword) or 0
    key = struct.pack("<HH", tag >> 16, tag & 0xFFFF)
    element = b"" if value is None else element_bytes(keyword, value + b" " * (len(value) % 2))
    found = find_elements(data)
    for place in found:
        if data[place.start : place.start + 4] == key:
            return data[: place.start] + element + data[place.end :]
    order = (tag >> 16, tag & 0xFFFF)
    greater = (
        place.start
        for place in found
        if struct.unpack("<HH", data[place.start : place.start + 4]) > order and place.start > 132 + 60
    )
    behind = next(greater, len(data))
    return data[:behind] + element + data[behind:]


def value_in(data: bytes, keyword: str) -> bytes:
    """The bytes of an element's value; empty if it is not there."""
    tag = tag_for_keyword(keyword) or 0
    key = struct.pack("<HH", tag >> 16, tag & 0xFFFF)
    return next((data[e.value : e.end] for e in find_elements(data) if data[e.start : e.start + 4] == key), b"")


SCOPES: dict[str, Callable[[int], tuple[int, ...]]] = {
    "an inner slice": lambda count: (count // 2,),
    "the first slice": lambda count: (0,),
    "the last slice": lambda count: (count - 1,),
    "all slices": lambda count: tuple(range(count)),
}


@functools.cache
def value_cases() -> list[tuple[str, bytes | None, str]]:
    """All of them: element, value, scope; shuffled, so that a short run sees some of everything."""
    middle = series()[COUNT // 2]
    cases: list[tuple[str, bytes | None, str]] = [
        (keyword, value, scope)
        for keyword in (*GEOMETRY, *PIXELS)
        for value in (None, *values_of(keyword, value_in(middle, keyword)))
        for scope in SCOPES
    ]
    random.Random("values").shuffle(cases)
    return cases


def values_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """One value of one element of one slice or of all; then pairs of such changes."""
    cases = value_cases()
    chosen = [cases[number]] if number < len(cases) else chance.sample(cases, 2)
    files = list(series())
    places: set[int] = set()
    for keyword, value, scope in chosen:
        for k in SCOPES[scope](COUNT):
            files[k] = put(files[k], keyword, value)
            places.add(k)
    words = "; ".join(f"{keyword} = {value!r:.80} in {scope}" for keyword, value, scope in chosen)

    def run() -> Answer:
        write_files(folder / "ct", files)
        return read(folder / "ct")

    return Trial(words, run, unharmed_series(), lambda answer: len(places) < COUNT and not is_near(answer))


def is_near(answer: Answer) -> bool:
    """True if only places differ from those of the even series, by no more than positions are rounded."""
    unharmed = unharmed_series().content
    grids = ("affine", "origins")
    if any(answer.content.get(name) != unharmed[name] for name in unharmed if name not in grids):
        return False
    moved = [np.array(json.loads(answer.content[name])) - np.array(json.loads(unharmed[name])) for name in grids]
    return float(np.linalg.norm(moved[1], axis=1).max() + np.abs(moved[0][:3, :3]).sum() * COUNT) <= ROUNDING_MM


@functools.cache
def unharmed_series() -> Answer:
    """The answer of the even series."""
    import tempfile

    with tempfile.TemporaryDirectory() as place:
        write_files(Path(place) / "ct", series())
        return read(Path(place) / "ct")


# --- bytes ---
@functools.cache
def corpus() -> dict[str, Seed]:
    """Small series in every transfer syntax, phases, and the files that come with pydicom."""
    phases = make_phases()
    return {**phantom_seeds(), "phases": Seed("phases", phases[len(phases) // 2], phases), **pydicom_seeds()}


def draw_change(chance: random.Random) -> tuple[str, int, Any]:
    """One change for `apply_changes`."""
    kind = chance.choice(
        ["value", "value", "value", "raw value", "length", "vr", "tag", "insert", "delete", "copy", "to end", "cut"]
        + ["bytes", "bytes"]
    )
    index = chance.randrange(10_001)
    what: Any = index
    if kind == "value":
        what = chance.choice([*TEXTS, *UIDS, *NUMBERS, chance.randbytes(chance.randrange(12))])
    elif kind == "raw value":
        what = chance.choice([*NUMBERS, chance.randbytes(chance.randrange(1, 5))])
    elif kind == "length":
        what = chance.choice([*LENGTHS, ("by", chance.randrange(-3, 4))])
    elif kind in ("vr", "tag", "insert"):
        what = chance.choice({"vr": VRS, "tag": TAGS, "insert": BLOBS}[kind])
    elif kind in ("delete", "copy", "to end"):
        what = chance.randrange(10_001)
    elif kind == "bytes":
        what = chance.randbytes(chance.randrange(1, 9))
    return kind, index, what


@functools.cache
def unharmed_seed(name: str) -> Answer:
    """The answer of a series of the corpus; empty where it is refused."""
    import tempfile

    from clrecon.errors import ClreconError

    with tempfile.TemporaryDirectory() as place:
        write_files(Path(place) / "ct", corpus()[name].series)
        try:
            return read(Path(place) / "ct", phase=1 if name == "phases" else None)
        except ClreconError:
            return Answer({})


def pixels_of(seed: Seed, data: bytes) -> bytes:
    """The bytes of the pixel data of an unharmed file."""
    plain = Seed(seed.name, data, seed.series).plain
    elements = find_elements(plain)
    return plain[elements[-1].value : elements[-1].end] if elements else plain


def holds(seed: Seed, data: bytes, part: bytes) -> bool:
    """True if a harmed file has these bytes still."""
    try:
        return part in Seed(seed.name, data, seed.series).plain
    except zlib.error:
        return False


def bytes_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """One to four changes of a slice, of all slices, or of a slice alone."""
    made = [*phantom_seeds(), "phases"]
    name = chance.choice(made) if number % 3 else chance.choice(list(corpus()))
    seed = corpus()[name]
    scope = chance.choice(["one", "one", "all", "alone"])
    changes = [draw_change(chance) for _ in range(chance.randrange(1, 5))]
    files = list(seed.series)
    middle = len(files) // 2
    for k in range(len(files)) if scope == "all" else [middle]:
        files[k] = apply_changes(seed, files[k], changes)
    is_alone = scope == "alone" or len(files) == 1
    pixels = pixels_of(seed, seed.series[middle])
    kept = not is_alone and scope == "one" and holds(seed, files[middle], pixels)
    unharmed = unharmed_seed(name)

    def contradicted(answer: Answer) -> bool:
        """Pixels of native syntaxes are data: only what stands round them can be held against the other slices."""
        if is_alone or scope == "all":
            return False
        changed = {key for key in {**unharmed.content, **answer.content} if not _equal(unharmed, answer, key)}
        return kept or len(changed) != 1 or not next(iter(changed)).startswith("slice")

    def run() -> Answer:
        write_files(folder / "ct", [files[middle]] if is_alone else files)
        force = number % 3 == 0 and number % 2 == 0
        return read(folder / "ct", phase=1 if name == "phases" else None, force=force)

    words = f"{name}, {scope}: " + "; ".join(f"{kind} {index} {what!r:.60}" for kind, index, what in changes)
    return Trial(words, run, unharmed, contradicted)


def _equal(one: Answer, other: Answer, key: str) -> bool:
    return one.content.get(key) == other.content.get(key)


def ends_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """A slice that is cut anywhere, or goes on with something else."""
    name = chance.choice([*phantom_seeds(), "phases"])
    seed = corpus()[name]
    files = list(seed.series)
    k = chance.randrange(len(files))
    data = files[k]
    if number % 4:
        length = chance.randrange(len(data))
        files[k], words = data[:length], f"{name}: file {k} ends after {length} of {len(data)} bytes"
    else:
        extra = chance.choice([b"\0", b"\xff", b"DICM", data[:200], ExplicitVRLittleEndian.encode(), *BLOBS])
        extra *= chance.choice([1, 2, 1000])
        files[k], words = data + extra, f"{name}: file {k} goes on with {extra[:30]!r} ({len(extra)} bytes)"

    def run() -> Answer:
        write_files(folder / "ct", files)
        return read(folder / "ct", phase=1 if name == "phases" else None)

    return Trial(words, run, unharmed_seed(name), lambda answer: True)
