"""An archive and a bucket that others have written: Orthanc in a network namespace, and moto's S3; skipped without."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import real_orthanc

from clrecon import read_volume
from clrecon.proof.phantom import PhantomSettings, write_phantom


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a tilted scan of a ball."""
    folder = tmp_path_factory.mktemp("scan") / "ct"
    write_phantom(folder, PhantomSettings(kind="sphere", size=(32, 32), slices=20, tilt=10.0, noise=20.0))
    for path in folder.iterdir():
        if path.suffix != ".dcm":
            path.unlink()  # the truth: certificates count the files of a folder
    return folder


def can_have_namespace() -> bool:
    return (
        bool(shutil.which("unshare"))
        and subprocess.run(["unshare", "-rn", "true"], capture_output=True).returncode == 0
    )


@pytest.mark.slow
@pytest.mark.skipif(not (shutil.which("Orthanc") and real_orthanc.PLUGIN.exists()), reason="Orthanc is not installed")
def test_scan_is_read_from_orthanc_as_from_its_folder_and_its_mesh_comes_back_byte_for_byte(
    scan: Path, tmp_path: Path
) -> None:
    if not can_have_namespace():
        pytest.skip("a network namespace cannot be made here, and Orthanc would listen on all interfaces")
    command = ["unshare", "-rn", sys.executable, real_orthanc.__file__, scan, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result.pop("dciodvfy") in ([], None)  # None: not installed
    assert result == {
        "voxels": True, "affine": True, "certificate": True, "store": 0, "models": 1, "stl": True,
    }  # fmt: skip


@pytest.fixture
def bucket(scan: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The URL of a folder with the scan in a bucket of moto, which runs with packages of its own."""
    program = shutil.which("moto_server")
    if program is None:
        pytest.skip("moto_server is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen([program, "-H", "127.0.0.1", "-p", str(port)], env=environment, **quiet)
    try:
        host = f"http://127.0.0.1:{port}"
        until = time.monotonic() + 30.0
        while True:
            try:
                put(f"{host}/scans", b"")
                break
            except OSError:
                assert server.poll() is None and time.monotonic() < until
                time.sleep(0.2)
        for path in scan.rglob("*.dcm"):
            put(f"{host}/scans/p/{path.name}", path.read_bytes())
        settings = {
            "AWS_ENDPOINT_URL": host, "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "me", "AWS_SECRET_ACCESS_KEY": "sesame",
        }  # fmt: skip
        for name, value in settings.items():
            monkeypatch.setenv(name, value)
        yield "s3://scans/p/"
    finally:
        server.terminate()
        server.wait()


def put(url: str, content: bytes) -> None:
    kind = {"Content-Type": "application/octet-stream"}  # moto waits for the rest of a form
    urllib.request.urlopen(urllib.request.Request(url, content, kind, method="PUT"), timeout=20).close()


@pytest.mark.slow
def test_scan_is_read_from_a_bucket_of_moto_as_from_its_folder(bucket: str, scan: Path) -> None:
    pytest.importorskip("obstore")
    of_bucket, of_folder = read_volume(bucket), read_volume(scan)
    assert np.array_equal(of_bucket.voxels, of_folder.voxels)
    assert np.array_equal(of_bucket.affine, of_folder.affine)
    assert of_bucket.report == of_folder.report
