"""A server of views of a painter that draws at once."""

from __future__ import annotations

import pytest
from web_views import Views, serving


@pytest.fixture
def views() -> Views:
    return Views()


@pytest.fixture
def served(views: Views):
    with serving(views.open) as running:
        yield running
