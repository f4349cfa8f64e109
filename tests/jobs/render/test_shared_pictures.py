"""Pictures by several devices: each is the picture of one of them, and they come in their order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clrecon.cli.main import main
from clrecon.jobs.devices import list_usable
from clrecon.jobs.render.picture_taker import PictureTaker
from clrecon.jobs.render.settings import RenderSettings
from clrecon.opencl import Device
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.reading import read_volume
from clrecon.rendering.movies import turntable_cameras
from clrecon.system.progress import ignore_progress


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shared") / "ct"
    write_phantom(folder, PhantomSettings(kind="torus", size=(40, 40), slices=20, noise=50.0))
    return folder


def test_pictures_that_two_takers_share_are_those_of_one_in_the_same_order(ct: Path, device: Device) -> None:
    settings = RenderSettings.of("dvr", size=(40, 40), views=("anterior", "left", "superior"))
    with PictureTaker(read_volume(ct), device, settings, ignore_progress) as taker:
        cameras = turntable_cameras(settings.camera(taker.box, "anterior", turning=True), 12)
        alone = [picture.image for picture in (*taker.take_views(), *taker.take_all(cameras))]
        taker.share_with([device])
        shared = [picture.image for picture in (*taker.take_views(), *taker.take_all(cameras))]
    assert len({image.tobytes() for image in alone}) > 6  # the order can be told
    assert np.array_equal(shared, alone)


def test_files_of_all_devices_are_those_of_one_and_the_report_names_all(ct: Path, tmp_path: Path) -> None:
    """Of a maximum projection, whose pictures are the same on every driver that was tried."""
    for name, device in {"one": str(list_usable()[0].index), "all": "all"}.items():
        (tmp_path / name).mkdir()
        files = ["-o", tmp_path / name / "p.png", "--turntable", tmp_path / name / "t", "--frames", "6"]
        how = ["--mode", "mip", "--view", "left", "--size", "40", "--device", device]
        report = ["--report", tmp_path / f"{name}.json"]
        assert main(["render", str(ct), *map(str, (*files, *how, *report)), "-q"]) == 0
    of_one = {path.relative_to(tmp_path / "one"): path.read_bytes() for path in (tmp_path / "one").rglob("*.png")}
    of_all = {path.relative_to(tmp_path / "all"): path.read_bytes() for path in (tmp_path / "all").rglob("*.png")}
    assert of_all == of_one
    assert len(of_one) == 1 + 6
    assert all(device.label in (tmp_path / "all.json").read_text() for device in list_usable())
