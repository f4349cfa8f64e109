"""``--memory``: amounts as people write them, slabs where they are needed, the same file."""

from __future__ import annotations

import json

import pytest

from clrecon.cli.main import main
from clrecon.jobs.options import parse_bytes


@pytest.mark.parametrize(
    ("text", "size"),
    [("1000", 1000), ("512B", 512), ("1.5kB", 1500), ("500MB", 500_000_000), ("2GiB", 2 * 2**30), ("2g", 2 * 10**9),
     ("64 MiB", 64 * 2**20), ("1TB", 10**12)],
)  # fmt: skip
def test_amounts_of_memory_are_read(text, size):
    assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["", "much", "-5MB", "5XB", "5iB", "MB", "1e9", "5MB5"])
def test_text_that_is_no_amount_of_memory_is_refused(text):
    with pytest.raises(ValueError, match="500MB or 2GiB"):
        parse_bytes(text)


@pytest.fixture(scope="module")
def ct_folder(tmp_path_factory):
    """A series of 40 slices of 64 x 64 voxels, 328 kB."""
    folder = tmp_path_factory.mktemp("memory") / "ct"
    assert main(["phantom", str(folder), "--kind", "sphere", "--size", "64", "--slices", "40", "-q"]) == 0
    return folder


def test_mesh_within_little_memory_is_made_in_slabs_and_its_file_is_that_of_the_whole(ct_folder, tmp_path, printed):
    assert main(["mesh", str(ct_folder), "-o", str(tmp_path / "whole.stl"), "--json"]) == 0
    whole = printed().report()
    command = ["mesh", str(ct_folder), "-o", str(tmp_path / "slabs.stl"), "--memory", "200kB", "--json"]
    assert main(command) == 0
    in_slabs = printed().report()

    assert (whole["slabs"], whole["memory_allowed_bytes"]) == (1, None)
    assert in_slabs["slabs"] > 1
    assert in_slabs["memory_allowed_bytes"] == 200_000
    assert sum(in_slabs["device_bytes"].values()) <= 200_000
    assert (tmp_path / "whole.stl").read_bytes() == (tmp_path / "slabs.stl").read_bytes()


def test_words_of_a_mesh_within_little_memory_have_the_number_of_slabs(ct_folder, tmp_path, printed):
    command = ["mesh", str(ct_folder), "-o", str(tmp_path / "slabs.stl"), "--memory", "200kB"]
    assert main([*command, "--report", str(tmp_path / "r.json")]) == 0
    printed().assert_output(json.loads((tmp_path / "r.json").read_text())["slabs"])


@pytest.mark.parametrize(("memory", "code", "fact"), [
    ("5kB", 5, 5000), ("0", 3, 0), ("lots", 3, "lots")])  # fmt: skip
def test_memory_budget_that_is_invalid_or_too_small_is_refused(ct_folder, tmp_path, printed, memory, code, fact):
    assert main(["mesh", str(ct_folder), "-o", str(tmp_path / "x.stl"), "--memory", memory]) == code
    printed().assert_error(fact)
    assert not (tmp_path / "x.stl").exists()
