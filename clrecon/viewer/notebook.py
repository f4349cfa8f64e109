"""What a notebook shows: HTML that works offline, and `LivePage`, the page of a view that this process serves."""

from __future__ import annotations

import base64
import threading
import weakref
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from html import escape
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import ClreconError
from clrecon.exchange.content import certificate_lines
from clrecon.exchange.formats import MOST_PARTS
from clrecon.geometry import Volume
from clrecon.points.cloud import PointCloud
from clrecon.reading.common.source_facts import SeriesListing
from clrecon.system.arguments import ViewName
from clrecon.system.base_classes import Closing
from clrecon.system.log import get_logger

if TYPE_CHECKING:
    from clrecon.jobs.view import ViewSettings
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.rendering import Rendering
    from clrecon.viewer.model.objects import ShownObject

log = get_logger(__name__)

_MOST_PAGE_BYTES = 2_000_000
"""Of a page within a notebook, which keeps all that it shows."""

_PAGE_HEIGHT = 480
_LIVE_HEIGHT = 640
_PATIENCE_S = 10.0
"""Until a port of this machine answers, or is given up."""

_PICTURE_SIZE = (640, 480)
_SLICE_SIZE = (280, 280)
_MOST_ROWS = 40
_LEAST_BYTES_OF_SCANS = 4
"""A triangle of a page: 5 to 8 were seen.  Pages that are too large for sure are not made first."""


def to_html(shown: Mesh | Volume | PointCloud | LabelMap | SeriesListing) -> str | None:
    """Return HTML that shows an object of clrecon, offline and without a script of others; what notebooks call.

    Parameters
    ----------
    shown : Mesh, Volume, PointCloud, LabelMap or SeriesListing
        A mesh is a page in a frame (``docs/view.md``), above 2 MB a picture; a volume three slices and its certificate;
        a cloud a picture; a label map and a listing a table.

    Returns
    -------
    str or None
        None where it cannot be shown, as without an OpenCL device: notebooks then show the text.  Nothing is raised.
    """
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh

    kinds: list[tuple[type, Any]] = [
        (Mesh, _show_mesh), (Volume, _show_volume), (PointCloud, _show_cloud), (LabelMap, _show_labels),
        (SeriesListing, _show_listing),
    ]  # fmt: skip
    for kind, show in kinds:
        if isinstance(shown, kind):
            try:
                return str(show(shown))
            except Exception as error:  # a notebook shows the text, not a traceback
                log.warning("%s is shown as text: %s", kind.__name__, error)
                return None
    return None


def _show_mesh(mesh: Mesh) -> str:
    from clrecon.exchange.page import compose_page

    if _LEAST_BYTES_OF_SCANS * mesh.triangle_count <= _MOST_PAGE_BYTES and mesh.triangle_count:
        page = compose_page(mesh.describe_parts("lps", MOST_PARTS))
        if len(page) <= _MOST_PAGE_BYTES:
            return (
                f'<iframe sandbox="allow-scripts" title="{escape(repr(mesh))}" width="100%" height="{_PAGE_HEIGHT}"'
                f' style="border: 0" srcdoc="{escape(page.decode())}"></iframe>'
            )
    if not mesh.triangle_count:
        return f"<p>{escape(repr(mesh))}</p>"
    return f"{_draw_object(mesh)}<p>{escape(repr(mesh))}; a page of it is a file: mesh.save('page.html')</p>"


def _show_cloud(cloud: PointCloud) -> str:
    text = f"<p>{escape(repr(cloud))}</p>"
    return _draw_object(cloud) + text if len(cloud.points) else text


def _draw_object(shown: Mesh | PointCloud) -> str:
    from clrecon.operators.rays.render import render

    return _image(render(shown, size=_PICTURE_SIZE, background="white").annotated(letters=True, scale_bar=True))


def _show_volume(volume: Volume) -> str:
    from clrecon.operators.reformat.cut import cut_slice

    try:
        views: tuple[ViewName, ...] = ("axial", "coronal", "sagittal")
        slices = [cut_slice(volume, view, _SLICE_SIZE).annotated(letters=True, scale_bar=True) for view in views]
        pictures = "".join(map(_image, slices))
    except ClreconError as error:  # no device: what is known of the volume is still shown
        pictures = f"<p>No slices: {escape(str(error))}</p>"
    rows = [line.partition(" ")[::2] for line in certificate_lines(volume.report)]
    known = _table(("certificate", ""), rows) if rows else "<p>No certificate.</p>"
    return f"<div>{pictures}</div><p>{escape(repr(volume))}</p>{known}"


def _show_labels(labels: LabelMap) -> str:
    from clrecon.rendering.pictures.label_style import distinct_colors

    voxel_ml = abs(float(np.linalg.det(labels.affine[:3, :3]))) / 1000.0
    colors = [
        f"rgb({','.join(str(round(255 * value)) for value in color)})" for color in distinct_colors(len(labels.numbers))
    ]
    rows = [
        (number, labels.name(number), f"{count:,}", f"{count * voxel_ml:,.2f}")
        for number, count in labels.counts.items()
    ]
    table = _table(("number", "name", "voxels", "ml"), rows, colors)
    return f"<p>{escape(repr(labels))}</p>{table}"


def _show_listing(listing: SeriesListing) -> str:
    rows = []
    for entry in listing.series:
        size = " x ".join(map(str, entry.shape_ijk or ()))
        spacing = " x ".join(f"{value:.4g}" for value in entry.spacing_mm or ())
        chosen = "read by default" if entry.number == listing.chosen else ""
        remarks = "; ".join((*entry.problems, *entry.warnings))
        rows.append((entry.number, entry.description, entry.modality, entry.slices, size, spacing, chosen, remarks))
    heads = ("series", "description", "modality", "slices", "voxels", "spacing mm", "", "remarks")
    return _table(heads, rows) + "".join(f"<p>{escape(text)}</p>" for text in listing.warnings)


def _image(picture: Rendering) -> str:
    content = base64.b64encode(picture._repr_png_()).decode()
    width, height = picture.size
    return (
        f'<img src="data:image/png;base64,{content}" width="{width}" height="{height}" alt="{escape(repr(picture))}">'
    )


def _table(heads: Sequence[str], rows: Sequence[Iterable[object]], colors: Sequence[str] = ()) -> str:
    """Return rows as a table, of many the first, each with a mark in its colour."""
    lines = ["<tr>" + "".join(f"<th>{escape(head)}</th>" for head in heads) + "</tr>"]
    for index, row in enumerate(rows[:_MOST_ROWS]):
        mark = f'<span style="color: {colors[index]}">&#9632;</span> ' if colors else ""
        cells = [escape(str(cell)) for cell in row]
        lines.append("<tr>" + "".join(f"<td>{mark * (n == 0)}{cell}</td>" for n, cell in enumerate(cells)) + "</tr>")
    more = f"<p>and {len(rows) - _MOST_ROWS:,} more</p>" if len(rows) > _MOST_ROWS else ""
    return f"<table>{''.join(lines)}</table>{more}"


class LivePage(Closing):
    """The page of ``clrecon view`` in a cell of a notebook, or in a browser of this machine, until it is closed.

    It ends with the process at the latest.  A notebook that is opened later shows the picture of the beginning.

    Attributes
    ----------
    address : str
        For a browser on this machine; whoever knows it sees the scan.
    """

    def __init__(self, objects: Sequence[ShownObject], settings: ViewSettings):
        from clrecon.viewer.session.opening import OpenedView
        from clrecon.viewer.web.server import WebServer

        with ExitStack() as opened:
            self._view = opened.enter_context(OpenedView(objects, settings))
            self._picture = self._draw()
            server = opened.enter_context(WebServer(is_framed=True))
            self.address, self.port = server.address, server.port
            folders: SimpleQueue[Path] = SimpleQueue()
            serve = partial(server.serve, self._view.session, folders.put)
            self._thread = threading.Thread(target=serve, name="clrecon-live-page", daemon=True)
            self._thread.start()
            opened.callback(self._thread.join, _PATIENCE_S)
            opened.callback(server.stop)
            self._folder = folders.get(timeout=_PATIENCE_S)
            self._end = weakref.finalize(self, opened.pop_all().close)

    def close(self) -> None:
        self._end()

    def open(self) -> None:
        """Open the page in the browser of this machine."""
        from clrecon.viewer.web.server import open_browser

        open_browser(self.address, self._folder)

    def __repr__(self) -> str:
        if not self._thread.is_alive():
            return "LivePage(closed)"
        return f"LivePage(port {self.port} of this machine: open() shows it in the browser)"

    def _repr_html_(self) -> str:
        frame = ""
        if self._thread.is_alive():
            frame = (
                f'<iframe src="{escape(self.address)}" title="{escape(repr(self))}" width="100%"'
                f' height="{_LIVE_HEIGHT}" style="border: 0"></iframe>'
            )
        return (
            f"{frame}<details{'' if frame else ' open'}><summary>Picture of the page as it begins; the page itself is"
            f" served to this machine alone, while its program runs</summary>{self._picture}</details>"
        )

    def _draw(self) -> str:
        model = self._view.model(_PICTURE_SIZE[0] / _PICTURE_SIZE[1])
        return _image(self._view.painter.picture(model.state, _PICTURE_SIZE))
