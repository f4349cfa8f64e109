"""Which picture a browser gets next: small ones while something moves, sharp ones at rest, the views by turns.

No clock, no thread, no socket: the connection tells what happened and asks what to draw.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from clrecon.viewer.session.picture_facts import VIEWS


class Asked(NamedTuple):
    """A picture to draw next."""

    view: str
    size: tuple[int, int]
    moving: bool


class Pace:
    """What is stale in one browser.

    moving: Something was changed a moment ago; set by `change` and cleared by `rest`.
    """

    def __init__(self) -> None:
        self.moving = False
        self._sizes: dict[str, tuple[int, int]] = {}
        # Both in the order in which the views are to be drawn.
        self._stale: dict[str, None] = {}
        self._coarse: dict[str, None] = {}

    def resize(self, sizes: dict[str, tuple[int, int]]) -> None:
        """Take the sizes in pixels of the views that the page shows; a new size makes a view stale."""
        for view in VIEWS:
            size = sizes.get(view)
            if size is None:
                self._sizes.pop(view, None)
                self._stale.pop(view, None)
                self._coarse.pop(view, None)
            elif size != self._sizes.get(view):
                self._sizes[view] = size
                self._stale[view] = None

    def change(self, views: Iterable[str]) -> None:
        """Note that these views show what is no longer so."""
        self.moving = True
        for view in views:
            if view in self._sizes:
                self._stale.setdefault(view)
                self._coarse.pop(view, None)

    def rest(self) -> None:
        """Note that nothing moves any more: what was drawn coarsely is drawn sharp."""
        self.moving = False

    def next(self) -> Asked | None:
        """Return what to draw now, and count it as drawn; None where everything is as it should be."""
        if self._stale:
            return self._take(next(iter(self._stale)))
        if self._coarse and not self.moving:
            return self._take(next(iter(self._coarse)))
        return None

    @property
    def is_done(self) -> bool:
        """True where nothing is left to draw."""
        return not (self._stale or self._coarse or self.moving)

    def instead(self, drawn: Asked) -> Asked | None:
        """Return what to draw in place of a picture that is being drawn: only of a sharp one that is stale again."""
        return self._take(drawn.view) if not drawn.moving and self.moving and drawn.view in self._stale else None

    def _take(self, view: str) -> Asked:
        self._stale.pop(view, None)
        self._coarse.pop(view, None)
        if self.moving:
            self._coarse[view] = None
        return Asked(view, self._sizes[view], self.moving)
