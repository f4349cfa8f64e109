"""Harmed clouds of points (PLY, VTP, NPZ, XYZ, LAS), read as such and by ``clrecon cloud``."""

from __future__ import annotations

import functools
import random
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from commands import COMMAND_LIMIT_S, LIBRARIES_BYTES, call_main, draw_options
from grids import damage
from trials import MEMORY_LIMIT_BYTES, Answer, Trial, digest

import clrecon

EXTENSIONS = (".ply", ".vtp", ".npz", ".xyz", *([".las"] if find_spec("laspy") else []))
WORDS = [
    b"", b"0", b"-1", b"nan", b"inf", b"1e39", b"1e999", b"\n", b"\0", b" ", b"x" * 300, b"float", b"double", b"char",
    b"list uchar int", b"ascii", b"binary_big_endian", b"vertex", b"element vertex 99999999999\n", b"end_header\n",
    b"property", b"RAS", b"SPACE=", b"Float64", b"UInt64", b"BigEndian", b"vtkZLibDataCompressor", b"appended",
    b"NumberOfComponents=\"0\"", b"<DataArray", b"</Piece>", b"<!ENTITY a 'a'>", b"&a;", b"'descr': 'O'", b"(0, 3)",
    b"<f8", b"(99999999999, 3)", b"\x93NUMPY", b"PK\x05\x06", b"LASF", b"\xff\xff\xff\xff", b"\x00\x00\xc0\x7f",
    b"1,2", b"#", b"1e5", b"-1e30", b"\xff\xfe", b"\x1b[31m", b"99999999999999999999",
]  # fmt: skip
"""Words of these formats, and numbers that none of them has a place for."""


@functools.cache
def clouds() -> dict[str, bytes]:
    """By name, files of a ball of points: all that formats can hold, points alone, and far from the origin."""
    chance = np.random.default_rng(4)
    normals = chance.normal(size=(120, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 6.0 * normals
    kinds = {
        "full": clrecon.PointCloud(points, normals, 200.0 + points[:, 0], np.arange(120) % 3 - 1),
        "bare": clrecon.PointCloud(points),
        "far": clrecon.PointCloud(points + 1e5, normals),
    }
    made = {}
    with tempfile.TemporaryDirectory() as place:
        for kind, cloud in kinds.items():
            for extension in EXTENSIONS:
                path = Path(place) / f"{kind}{extension}"
                cloud.save(path)
                made[path.name] = path.read_bytes()
    return made


def clouds_trial(number: int, folder: Path, chance: random.Random) -> Trial:
    """A file of points with up to three damages, read by the function or by the command with odd options."""
    name = chance.choice(list(clouds()))
    data, words = clouds()[name], []
    by_command = chance.random() < 0.5
    for _ in range(chance.randrange(0 if by_command else 1, 4)):
        data, said = damage(data or b"\0", chance, WORDS, 1500)
        words.append(said)
    place = folder / "ct"  # what is there is input
    place.mkdir(exist_ok=True)
    (place / name).write_bytes(data)
    if not by_command:
        return Trial(
            f"{name}: " + "; ".join(words), lambda: answer_of_cloud(place / name), unharmed_cloud(name), lambda _: False
        )
    given = ["cloud", str(place / name), "-o", str(folder / f"out{chance.choice(EXTENSIONS)}")]
    given += draw_options("cloud", chance, chance.randrange(0, 4))
    said = f"{name}: " + "; ".join([*words, " ".join(f"{text!r:.100}" for text in given[4:])])
    limit_bytes = MEMORY_LIMIT_BYTES + LIBRARIES_BYTES
    return Trial(
        said, lambda: call_main(given, folder), Answer({"exit": "0"}), lambda _: False, COMMAND_LIMIT_S, limit_bytes
    )


def answer_of_cloud(path: Path) -> Answer:
    """What a file of points is, by name."""
    cloud = clrecon.read_points(path)
    parts = {name: getattr(cloud, name) for name in ("points", "normals", "hu", "labels")}
    content = {name: digest(np.ascontiguousarray(part)) for name, part in parts.items() if part is not None}
    file = cloud.report["file"]
    return Answer({**content, "space": file["space"]}, tuple(file["warnings"]), str(cloud.report))


@functools.cache
def unharmed_cloud(name: str) -> Answer:
    """The answer of a file as it was written."""
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / name).write_bytes(clouds()[name])
        return answer_of_cloud(Path(place) / name)
