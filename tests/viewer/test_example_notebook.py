"""The example notebook: it runs, its outputs show themselves, and what nbconvert writes works without a network."""

from __future__ import annotations

import os

import pytest
from browser import open_browser, severe_lines, wait_for
from house import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.opencl]

NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
KINDS = {"list_series": "<table>", "volume": "<img", "mesh": "<iframe sandbox=", "extract_points": "<img"}


def list_outputs(notebook) -> list[tuple[str, dict[str, str]]]:
    """The last line of each cell that shows something, and what it shows by type."""
    return [
        (cell.source.splitlines()[-1], output.data)
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if "data" in output
    ]


def check_outputs(notebook) -> None:
    """Assert that each kind of object shows itself, the last cell a picture, and that nothing is printed."""
    outputs = list_outputs(notebook)
    for name, start in KINDS.items():
        (html,) = [data["text/html"] for source, data in outputs if source == name or f"clrecon.{name}(" in source]
        assert start in html
    assert "image/png" in outputs[-1][1]
    said = [out for cell in notebook.cells for out in cell.get("outputs", []) if out.output_type in ("stream", "error")]
    assert said == []  # no warning of a library, no traceback


@pytest.mark.release
def test_notebook_runs_and_shows_what_the_kept_one_shows(device):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    kept = nbformat.read(NOTEBOOK, as_version=4)
    check_outputs(kept)
    fresh = nbformat.read(NOTEBOOK, as_version=4)
    for cell in fresh.cells:
        cell.outputs = [] if cell.cell_type == "code" else cell.get("outputs", [])
    nbclient.NotebookClient(fresh, timeout=300, kernel_name="python3", resources={"metadata": {"path": ROOT}}).execute()
    check_outputs(fresh)
    assert [source for source, _ in list_outputs(fresh)] == [source for source, _ in list_outputs(kept)]
    assert os.path.getsize(NOTEBOOK) < 2_000_000  # bytes that a clone of the repository fetches; it has 0.6 MB


@pytest.mark.release
def test_page_of_the_notebook_is_drawn_after_nbconvert(tmp_path):
    nbconvert = pytest.importorskip("nbconvert")
    text, _ = nbconvert.HTMLExporter().from_filename(str(NOTEBOOK))
    path = tmp_path / "notebook.html"
    path.write_text(text, encoding="utf-8")
    no_network = "--host-resolver-rules=MAP * ~NOTFOUND"
    with open_browser(no_network, width=1000, height=900) as driver:
        driver.get(path.as_uri())
        frame = wait_for(driver, "return document.querySelector('iframe')")
        driver.execute_script("arguments[0].scrollIntoView()", frame)
        own_lines = [line for line in severe_lines(driver) if "ERR_NAME_NOT_RESOLVED" not in line]  # its template's
        assert own_lines == []
        driver.switch_to.frame(frame)
        wait_for(driver, "return document.documentElement.dataset.ready")
        assert len(driver.find_elements("css selector", "#parts li")) > 1
        driver.switch_to.default_content()
        if folder := os.environ.get("CLRECON_KEEP_PICTURES"):
            driver.save_screenshot(f"{folder}/notebook.png")
