"""Harmed volumes and label maps that are not slices of DICOM: NIfTI, NRRD, MetaImage, DICOM SEG."""

from __future__ import annotations

import functools
import random
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dicom_series import Plan, make_dataset
from hostile_bytes import Seed, apply_changes
from label_files import make_labels, write_nifti, write_nrrd, write_seg
from slices import answer_of, draw_change
from trials import Answer, Trial, digest
from volume_files import OBLIQUE, WRITERS, make_ct

import clrecon
from clrecon.labels import read_labels

SHAPE = (5, 6, 7)
WORDS = [
    b"", b"0", b"-1", b"nan", b"inf", b"1e999", b"=", b"\n", b"\0", b" 1", b"x" * 300, b"LIST", b"LOCAL", b"../x",
    b"%d", b"100000", b"2147483648", b"99999999999999999999", b"MET_INT", b"MET_DOUBLE", b"gzip", b"raw", b"(1,0,0)",
    b"\xff\xfe", b"left-anterior-superior", b"none", b"true", b"False", b"3", b"4", b"1 2", b"/dev/zero", b"\x1b[31m",
]  # fmt: skip


@functools.cache
def volumes() -> dict[str, dict[str, bytes]]:
    """By the name of its main file, the files of a volume of each kind."""
    made = {}
    for name, write in WRITERS.items():
        with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write(Path(place) / name, make_ct(SHAPE), OBLIQUE)
            made[name] = {file.name: file.read_bytes() for file in Path(place).iterdir()}
    return made


@functools.cache
def label_maps() -> dict[str, dict[str, bytes]]:
    """By name, the file of a label map of each kind on one grid."""
    labels = make_labels(SHAPE)
    made = {}
    plan = Plan(shape=SHAPE)
    slices = []
    for k in range(SHAPE[0]):
        slices.append(make_dataset(plan, k))
        slices[-1].StudyInstanceUID, slices[-1].StudyDate, slices[-1].StudyTime = "1.2.3.4", "20200101", "120000"
        for keyword in ("AccessionNumber", "StudyID", "PatientBirthDate", "PatientSex", "ReferringPhysicianName"):
            setattr(slices[-1], keyword, "")
    writers: dict[str, Callable[[Path], Any]] = {
        "labels.nii.gz": lambda path: write_nifti(path, labels),
        "labels.nii": lambda path: write_nifti(path, labels),
        "labels.nrrd": lambda path: write_nrrd(path, labels, encoding="gzip"),
        "labels.dcm": lambda path: write_seg(path, [("L1", labels == 2), ("L2", labels == 5)], slices),
    }
    for name, write in writers.items():
        with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write(Path(place) / name)
            made[name] = {name: (Path(place) / name).read_bytes()}
    return made


def damage(data: bytes, chance: random.Random, words: Sequence[bytes] = WORDS, header: int = 400) -> tuple[bytes, str]:
    """Change a few bytes, most of them in the header."""
    kind = chance.choice(["word", "word", "bytes", "bytes", "cut", "more", "far bytes"])
    head = min(len(data), header)
    if kind == "cut":
        length = chance.randrange(len(data))
        return data[:length], f"ends after {length}"
    if kind == "more":
        extra = chance.choice([b"\0", chance.randbytes(50), data[:300], b"\n"])
        return data + extra, f"goes on with {extra[:20]!r}"
    place = chance.randrange(len(data) if kind == "far bytes" else head)
    new = chance.choice(words) if kind == "word" else chance.randbytes(chance.randrange(1, 9))
    over = chance.randrange(len(new) + 4) if kind == "word" else len(new)
    return data[:place] + new + data[place + over :], f"{new!r:.60} for {over} bytes at {place}"


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        (folder / name).write_bytes(data)


def volumes_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """A volume with one to three damages."""
    name = chance.choice(list(volumes()))
    files = dict(volumes()[name])
    words = []
    for _ in range(chance.randrange(1, 4)):
        part = chance.choice([name, name, *files])
        files[part], said = damage(files[part] or b"\0", chance)
        words.append(f"{part} {said}")

    def run() -> Answer:
        write(folder, files)
        return answer_of(clrecon.read_volume(folder / name))

    return Trial("; ".join(words), run, unharmed_volume(name), is_packed(name))


def is_packed(name: str) -> Callable[[Answer], bool]:
    """Voxels with a checksum differ only where it was changed too: their header may say what it wants."""
    packed = name in ("a.nii.gz", "gzip.nrrd", "packed.mha", "packed.mhd")

    def contradicted(answer: Answer) -> bool:
        unharmed = unharmed_volume(name).content
        same_grid = all(answer.content.get(key) == unharmed[key] for key in ("shape", "affine"))
        changed = [
            key for key in answer.content if key.startswith("slice") and answer.content[key] != unharmed.get(key)
        ]
        return packed and same_grid and 0 < len(changed) < SHAPE[0]

    return contradicted


@functools.cache
def unharmed_volume(name: str) -> Answer:
    """The answer of a volume as it was written."""
    with tempfile.TemporaryDirectory() as place:
        write(Path(place), volumes()[name])
        return answer_of(clrecon.read_volume(Path(place) / name))


def labels_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """A label map with one to three damages."""
    name = chance.choice(list(label_maps()))
    data = label_maps()[name][name]
    words = []
    if name.endswith(".dcm"):
        changes = [draw_change(chance) for _ in range(chance.randrange(1, 4))]
        data = apply_changes(Seed(name, data, (data,)), data, changes)
        words = [f"{kind} {index} {what!r:.60}" for kind, index, what in changes]
    else:
        for _ in range(chance.randrange(1, 4)):
            data, said = damage(data or b"\0", chance)
            words.append(said)

    def run() -> Answer:
        (folder / name).write_bytes(data)
        return answer_of_labels(folder / name)

    return Trial(f"{name}: " + "; ".join(words), run, unharmed_labels(name), lambda answer: False)


def answer_of_labels(path: Path) -> Answer:
    """What a label map is, by name."""
    found = read_labels(path)
    content = {"affine": str(np.asarray(found.affine).round(6).tolist()), "shape": str(found.voxels.shape)}
    return Answer({**content, "voxels": digest(found.voxels.copy()), "names": str(found.names)})


@functools.cache
def unharmed_labels(name: str) -> Answer:
    """The answer of a label map as it was written."""
    with tempfile.TemporaryDirectory() as place:
        write(Path(place), label_maps()[name])
        return answer_of_labels(Path(place) / name)
