"""Write the tables of label maps and volumes in docs/calibration.md, from the rows of tests/support/label_matrix.py.

python scripts/guide/make_label_tables.py
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))

from label_matrix import table_of_places, table_of_rows  # type: ignore[import-not-found]  # noqa: E402
from marked_tables import markdown_table, put_table  # noqa: E402


def main() -> None:
    """Write both tables."""
    page = ROOT / "docs" / "calibration.md"
    text = page.read_text(encoding="utf-8")
    text = put_table(text, "places of formats", markdown_table(*table_of_places()))
    text = put_table(text, "odd label files", markdown_table(*table_of_rows()))
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
