#!/usr/bin/env python3
"""List the constants in mm and HU of anatomy, labels and operators, for the table of docs/limits.md.

    python scripts/guide/make_constants_table.py

A constant is a name in capitals with _MM, _MM2, _CM2, _ML or _HU in it, at the top of a module; what it was made for is
the first sentence of the text below it.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).resolve().parent))

from marked_tables import markdown_table, put_table  # noqa: E402

PAGE, NAME = ROOT / "docs" / "limits.md", "constants in mm and HU"
ROOMS = ("anatomy", "labels", "operators")
UNITS = re.compile(r"^[A-Z].*_(MM2?|CM2|ML|HU)(_|$)")

ADULTS = "nothing: chosen for adults"
HU = "values: only HU"
SCALED = "values: scaled if they are not HU"
WRITERS = "nothing: how programs round in files"
LENGTHS = {
    "anatomy/body.py": "voxel: a cell has at least one voxel; otherwise chosen for adults",
    "anatomy/body_cells.py": "voxel: a cell has at least one voxel",
    "anatomy/dense_pieces.py": "nothing: chosen for adults and their equipment",
    "anatomy/head.py": "nothing: chosen for heads of people",
    "anatomy/spine_cells.py": ADULTS,
    "anatomy/spine_line.py": ADULTS,
    "anatomy/surroundings.py": "nothing: chosen for skin and airways of people",
    "labels/canal.py": ADULTS,
    "labels/contours.py": WRITERS,
    "labels/label_grids.py": WRITERS,
    "labels/segmentation.py": WRITERS,
    "labels/structures.py": "voxel: distance to the next slice; otherwise how programs round in files",
    "operators/masks/enclosed.py": "voxel: the ball of `--solid` has a radius of at most 8 times the largest voxel"
    " step; object: volume of the bone; otherwise chosen for marrow of adults",
    "operators/masks/regions.py": WRITERS,
    "operators/masks/shapes.py": WRITERS,
    "operators/points/clusters.py": WRITERS,
    "operators/points/free_clusters.py": "nothing: range of float32",
    "operators/rays/mesh_pictures.py": "nothing: range of float32",
    "operators/rays/point_pictures.py": "object: spacing of the cloud, if it has one",
    "operators/reformat/cut.py": ADULTS,
    "operators/surface/cortex.py": "voxel: scaled from a voxel of 1 mm3",
    "operators/surface/cortex_fit.py": "nothing: limit of a search",
    "operators/surface/cortex_mesh.py": "nothing: precision of float32",
    "operators/surface/growing.py": "nothing: limit of a search",
    "operators/surface/seeds.py": ADULTS,
    "operators/vertebrae/inside.py": "nothing: chosen for vertebrae of adults",
    "operators/vertebrae/solid.py": "nothing: chosen for vertebrae of adults",
}
"""What the lengths, areas and volumes of a module follow; a module that has some and no line is an error."""

VALUES = {"anatomy/iso_choice.py": SCALED, "anatomy/materials.py": SCALED}
"""What the constants in HU of a module follow, where they do not mean HU alone."""

SHOWN_BY = {
    "anatomy/body.py": "anatomy/test_body_bone.py::test_a_block_of_micro_ct_with_large_cells_stays_whole",
    "anatomy/body_cells.py": "anatomy/test_body_cells.py::test_counts_of_cells_hold_every_voxel_of_micro_ct",
    "anatomy/iso_choice.py": "anatomy/test_iso_choice.py"
    "::test_iso_value_on_the_scale_of_the_scan_itself_lies_half_way_between_its_materials",
    "anatomy/materials.py": "anatomy/test_iso_choice.py"
    "::test_iso_value_on_the_scale_of_the_scan_itself_lies_half_way_between_its_materials",
    "labels/structures.py": (
        "labels/test_structure_sets.py::test_contour_within_a_tenth_of_the_step_of_its_slice_is_read_with_a_warning"
    ),
    "operators/masks/enclosed.py": "operators/masks/test_enclosed.py::test_the_default_seal_follows_voxels_and_bone",
    "operators/rays/point_pictures.py": "operators/rays/test_point_pictures.py"
    "::test_discs_are_as_large_as_points_lie_apart",
    "operators/surface/cortex.py": "operators/surface/test_cortex.py"
    "::test_fitted_shell_is_nearer_to_bone_than_the_level",
}
"""The test that shows what is said of a module whose constants follow the voxel or the values."""


def describe_follows(module: str, names: str) -> str:
    """Say what constants follow, by the units of their names: lengths by the module, HU by the values."""
    units = [match[1] for match in map(UNITS.match, names.split(", ")) if match]
    said = [LENGTHS[module]] if any(unit != "HU" for unit in units) else []
    return "; ".join(said + [VALUES.get(module, HU)] * ("HU" in units))


def find_constants(source: str) -> Iterator[tuple[str, str, str]]:
    """Yield names, value and first sentence of each constant with a unit."""
    body = ast.parse(source).body
    for statement, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
            continue
        target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
        names = [part.id for part in ast.walk(target) if isinstance(part, ast.Name)]
        if not any(UNITS.match(name) for name in names):
            continue
        said = ""
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
            said = re.split(r"(?<=[.])\s+(?=[A-Z`])", " ".join(after.value.value.split()))[0].rstrip(".")
        yield ", ".join(names), ast.unparse(statement.value), said


def make_table(root: Path = ROOT / "clrecon") -> str:
    """Return the table of all constants, by module."""
    rows = []
    for room in ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            module = path.relative_to(root).as_posix()
            for names, value, said in find_constants(path.read_text(encoding="utf-8")):
                cells = (module.removesuffix(".py"), names, value, said, describe_follows(module, names))
                rows.append([cell.replace("|", "\\|") for cell in cells])
    return markdown_table(["module", "constant", "value", "meaning", "adapts to"], rows)


def main() -> int:
    PAGE.write_text(put_table(PAGE.read_text(encoding="utf-8"), NAME, make_table()), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
