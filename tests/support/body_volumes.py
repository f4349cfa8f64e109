"""Ellipses of tissue and tables in air."""

from __future__ import annotations

import numpy as np

from clrecon.geometry import Volume

SHAPE = (12, 170, 200)

AFFINE = np.array([[2.0, 0, 0, -200.0], [0, 1.8, 0.2, -150.0], [0, 0, 2.5, 10.0], [0, 0, 0, 1.0]])

X, Y = (np.arange(200) - 99.5)[None] * 2.0, (np.arange(170)[:, None] - 84.5) * 1.8


def ellipse(x: float, y: float, a: float, b: float) -> np.ndarray:
    """Mask (rows, columns) of an ellipse, mm around the centre of the slice."""
    return ((X - x) / a) ** 2 + ((Y - y) / b) ** 2 <= 1.0


def make_patient(*, lungs: bool = False, arms: bool = True, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """HU and the mask of the patient: body with spine and ribs, arms with bone, a gas bubble, an ear-like flap."""
    hu = np.full(SHAPE, -1000.0)
    body = ellipse(0, -10, 120, 75)
    parts = [(body, 40.0), (body & ~ellipse(0, -10, 112, 67), 300.0), (body & ~ellipse(0, -10, 106, 61), 40.0)]
    if lungs:
        parts += [(ellipse(s * 58, -10, 46, 52), -860.0) for s in (-1, 1)]
    parts += [(ellipse(0, 35, 14, 14), 500.0), (ellipse(15, -63, 18, 10), -1000.0)]
    flap = (abs(X) < 3) & (Y > -100) & (Y < -80)
    parts += [(flap, 60.0)]
    patient = body | flap
    if arms:
        for side in (-1, 1):
            arm = ellipse(side * 158, 0, 28, 30)
            patient |= arm
            parts += [(arm, 40.0), (ellipse(side * 158, 0, 9, 9), 900.0)]
    for mask, value in parts:
        hu[:, mask] = value
    return hu + np.random.default_rng(seed).normal(0, 8, SHAPE), patient


def add_table(hu: np.ndarray, patient: np.ndarray, *, gap: float = 6.0) -> np.ndarray:
    """A shell 4 mm thick below the patient, a blanket between, a foam core, a tray further down; returns its mask."""
    table = (abs(Y - (67 + gap)) < 2.2) | (abs(Y - (90 + gap)) < 2.2) | (abs(Y - 140) < 2.2)
    table = (table & (abs(X) < 180)) | ((abs(abs(X) - 180) < 2.2) & (Y > 67 + gap) & (Y < 90 + gap))
    foam = (Y > 69 + gap) & (Y < 88 + gap) & (abs(X) < 178)
    blanket = (Y > 60) & (Y < 67 + gap) & (abs(X) < 150)
    for mask, value in ((foam, -960.0), (blanket, -900.0), (table, 350.0)):
        hu[:, mask & ~patient] = value
    return table & ~patient


def as_volume(hu: np.ndarray) -> Volume:
    """The HU in whole numbers, as a scan."""
    return Volume(np.rint(hu).astype(np.int16), AFFINE)
