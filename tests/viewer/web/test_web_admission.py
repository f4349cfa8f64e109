"""Who is let in: hosts, origins and the secret."""

from __future__ import annotations

import pytest

from clrecon.viewer.web.server import make_secret, refuse_request

pytestmark = pytest.mark.unit

SECRET = "a-SECRET_of-43-characters-as-they-are-made-0"


def test_hundred_secrets_are_long_and_all_different() -> None:
    made = {make_secret() for _ in range(100)}
    assert len(made) == 100
    assert min(map(len, made)) >= 43  # 256 bits, 6 a letter


@pytest.mark.parametrize("host", ["127.0.0.1:8000", "localhost:1", "LOCALHOST:65535", "[::1]:80", "127.0.0.1"])
def test_request_of_this_machine_is_let_in(host: str) -> None:
    assert refuse_request(host, origin=None, given=SECRET, secret=SECRET) is None
    assert refuse_request(host, origin=f"http://{host}", given=SECRET, secret=SECRET, by_page=True) is None


@pytest.mark.parametrize(
    "host",
    [
        None, "", "evil.example", "evil.example:8000", "127.0.0.1.evil.example:8000", "localhost.evil.example",
        "127.0.0.1:8000@evil.example", "192.168.0.7:8000", "0.0.0.0:8000", "127.0.0.1:8000 ", "xlocalhost:8000",
    ],
)  # fmt: skip
def test_foreign_host_is_refused(host: str | None) -> None:
    assert "127.0.0.1 and localhost alone" in refuse_request(host, origin=None, given=SECRET, secret=SECRET)


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example", "null", "", "https://127.0.0.1:8000", "http://127.0.0.1:8001", "http://localhost:8000",
        "http://127.0.0.1:8000.evil.example",
    ],
)  # fmt: skip
def test_foreign_origin_is_refused_with_the_right_secret(origin: str) -> None:
    assert "another server" in refuse_request("127.0.0.1:8000", origin, given=SECRET, secret=SECRET)


def test_request_that_only_pages_make_needs_an_origin() -> None:
    without_origin = {"host": "127.0.0.1:8000", "origin": None, "given": SECRET, "secret": SECRET}
    assert refuse_request(**without_origin) is None
    assert "another server" in refuse_request(**without_origin, by_page=True)


@pytest.mark.parametrize("given", [None, "", SECRET[:-1], SECRET + "x", SECRET.swapcase(), "é", "\udcff"])
def test_wrong_secret_is_refused_in_a_line_that_does_not_hold_it(given: str | None) -> None:
    said = refuse_request("127.0.0.1:8000", origin=None, given=given, secret=SECRET)
    assert said.startswith("refused: the secret is missing or wrong")
    assert SECRET not in said and "\n" not in said
