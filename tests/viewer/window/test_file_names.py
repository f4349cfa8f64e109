"""Names that no file has."""

from __future__ import annotations

import pytest

from clrecon.viewer.window.file_names import free_name


@pytest.mark.parametrize(
    ("wanted", "second", "third"),
    [
        ("bone.stl", "bone-2.stl", "bone-3.stl"),
        ("ct.nii.gz", "ct-2.nii.gz", "ct-3.nii.gz"),
        ("a.b.stl", "a.b-2.stl", "a.b-3.stl"),
    ],
)
def test_numbers_are_counted_until_one_is_free(tmp_path, wanted, second, third):
    assert free_name(tmp_path / wanted) == tmp_path / wanted
    (tmp_path / wanted).touch()
    assert free_name(tmp_path / wanted) == tmp_path / second
    (tmp_path / second).symlink_to(tmp_path / "nowhere")  # a name that is taken, though nothing is there
    assert free_name(tmp_path / wanted) == tmp_path / third
