#!/usr/bin/env python3
"""Count how many lanes of a graphics card work while its kernels write a surface: the SIMD efficiency.

    python scripts/proof/count_lanes.py [--slices N] [--iso HU] [--lanes 32]

A card runs its work-items in groups of 32 lanes (NVIDIA) or 64 (AMD), in step: a loop goes on for all lanes of a group
until the item with the most turns has made them.  The turns of each item follow from the mask of a surface, so no card
is needed.  The spine phantom of 512 x 512 pixels is counted.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from clrecon.proof.surface.case_table import CORNERS, case_table  # noqa: E402

Turns = NDArray[np.int64]

WEIGHTS = {"vertex": 390, "triangle": 300, "listed word": 220, "listed vertex": 38, "listed triangle": 43}
"""Instructions of a turn, about, in the text for NVIDIA's assembler (sm_86)."""


class WordCounts(NamedTuple):
    """Vertices and triangles of each word with work, in the order of the words."""

    vertices: Turns
    triangles: Turns


def sum_words(counts: NDArray[np.uint8]) -> Turns:
    """Sums over each 32 samples of rows, shape (..., words)."""
    pad = -counts.shape[-1] % 32
    padded = np.pad(counts, [(0, 0)] * (counts.ndim - 1) + [(0, pad)])
    return padded.reshape(*counts.shape[:-1], -1, 32).sum(axis=-1, dtype=np.int64)


def count_words(inside: NDArray[np.bool_]) -> WordCounts:
    """Count what the words of a mask own, (gk, gj, gi), slice by slice."""
    triangles_of = np.array([len(row) for row in case_table()], np.uint8)
    parts: list[tuple[Turns, Turns]] = []
    for k, own in enumerate(inside):
        above = inside[min(k + 1, len(inside) - 1)]
        owned = np.zeros(own.shape, np.uint8)
        owned[:, :-1] += own[:, :-1] != own[:, 1:]
        owned[:-1] += own[:-1] != own[1:]
        owned += own != above
        triangles = np.zeros(own.shape, np.uint8)
        if k + 1 < len(inside):
            cases = np.zeros((own.shape[0] - 1, own.shape[1] - 1), np.uint8)
            for corner, (x, y, z) in enumerate(CORNERS):
                rows = above if z else own
                cases |= rows[y : len(cases) + y, x : cases.shape[1] + x].astype(np.uint8) << np.uint8(corner)
            triangles[:-1, :-1] = triangles_of[cases]
        parts.append((sum_words(owned).ravel(), sum_words(triangles).ravel()))
    vertices, triangle_counts = (np.concatenate(column) for column in zip(*parts, strict=True))
    has_work = (vertices > 0) | (triangle_counts > 0)
    return WordCounts(vertices[has_work], triangle_counts[has_work])


def busy_share(turns: Turns, lanes: int) -> float:
    """Turns of all work-items, of the turns that their groups of `lanes` wait for."""
    groups = np.pad(turns, (0, -len(turns) % lanes)).reshape(-1, lanes)
    return float(turns.sum() / (lanes * groups.max(axis=1).sum()))


def efficiencies(counts: WordCounts, lanes: int) -> dict[str, float]:
    """The share of busy lanes by kernel, and of all three by their instructions."""
    word_vertices, word_triangles = counts
    turns = {
        "vertex": np.ones(word_vertices.sum(), np.int64),
        "triangle": np.ones(word_triangles.sum(), np.int64),
        "listed word": np.ones(len(word_vertices), np.int64),
        "listed vertex": word_vertices,
        "listed triangle": word_triangles,
    }
    shares = {name: busy_share(each, lanes) for name, each in turns.items()}
    work = {name: WEIGHTS[name] * each.sum() for name, each in turns.items()}
    issued = sum(work[name] / shares[name] for name in turns)
    return {
        "emit_vertices, an item a word": busy_share(counts.vertices, lanes),
        "emit_triangles, an item a word": busy_share(counts.triangles, lanes),
        "emit_vertices": shares["vertex"],
        "emit_triangles": shares["triangle"],
        "list_output, vertices": shares["listed vertex"],
        "list_output, triangles": shares["listed triangle"],
        "all three, by instructions": sum(work.values()) / issued,
    }


def main() -> None:
    from clrecon.proof.phantom import PhantomSettings, make_phantom

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--slices", type=int, default=149)
    parser.add_argument("--iso", type=float, default=226.0, metavar="HU")
    parser.add_argument("--lanes", type=int, default=32)
    options = parser.parse_args()
    settings = PhantomSettings(kind="spine", size=(512, 512), slices=options.slices, spacing=(0.7, 0.7, 1.0))
    voxels, _, _ = make_phantom(settings)
    counts = count_words(np.pad(voxels >= options.iso, 1))
    print(f"{len(counts.vertices):,} words, {counts.vertices.sum():,} vertices, {counts.triangles.sum():,} triangles")
    for kernel, share in efficiencies(counts, options.lanes).items():
        print(f"{kernel:32s} {share:.2f}")


if __name__ == "__main__":
    main()
