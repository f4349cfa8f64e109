"""A real Orthanc beside clrecon, in a network namespace of its own, where it reaches and is reached by nothing else.

    unshare -rn python tests/support/real_orthanc.py FOLDER_OF_A_SCAN EMPTY_FOLDER

Debian's Orthanc listens on all interfaces whatever its settings say: hence the namespace.  The result is printed as
JSON.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
import urllib.request
from io import BytesIO
from pathlib import Path
from typing import Any

PORT = 18042
PLUGIN = Path("/usr/share/orthanc/plugins/libOrthancDicomWeb.so")
_SECONDS_TO_START = 30.0


def _ask(path: str, content: bytes | None = None) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{PORT}/{path}", content, timeout=10) as answer:
        return bytes(answer.read())


def _start(folder: Path) -> subprocess.Popen[bytes]:
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    settings: dict[str, Any] = {
        "StorageDirectory": str(folder / "db"), "IndexDirectory": str(folder / "db"), "HttpPort": PORT,
        "DicomServerEnabled": False, "RemoteAccessAllowed": False, "AuthenticationEnabled": False,
        "Plugins": [str(PLUGIN)], "DicomWeb": {"Enable": True, "Root": "/dicom-web/"},
    }  # fmt: skip
    (folder / "orthanc.json").write_text(json.dumps(settings))
    with (folder / "orthanc.log").open("wb") as log:
        server = subprocess.Popen(["Orthanc", folder / "orthanc.json"], stdout=log, stderr=log)
    until = time.monotonic() + _SECONDS_TO_START
    while server.poll() is None:
        try:
            _ask("system")
            return server
        except OSError:
            if time.monotonic() > until:
                server.kill()
                raise
            time.sleep(0.2)
    raise RuntimeError((folder / "orthanc.log").read_text()[-500:])


def compare(scan: Path, folder: Path) -> dict[str, Any]:
    """Read a scan from the archive and from its folder, store its mesh, and get that back."""
    import numpy as np
    import pydicom

    from clrecon import read_volume
    from clrecon.cli.main import main

    files = sorted(path for path in scan.rglob("*.dcm"))
    for path in files:
        _ask("instances", path.read_bytes())
    header = pydicom.dcmread(files[0], stop_before_pixels=True)
    root = f"dicomweb+http://127.0.0.1:{PORT}/dicom-web"
    url = f"{root}/studies/{header.StudyInstanceUID}/series/{header.SeriesInstanceUID}"
    of_archive, of_folder = read_volume(url), read_volume(scan)
    mesh = folder / "mesh.stl"
    code = main(["mesh", str(scan), "-o", str(mesh), "--hu", "0", "-q", "--store", root])
    kinds = {one: json.loads(_ask(f"instances/{one}/simplified-tags")) for one in json.loads(_ask("instances"))}
    stored = [_ask(f"instances/{one}/file") for one, tags in kinds.items() if tags["Modality"] == "M3D"]
    model = pydicom.dcmread(BytesIO(stored[0]))
    (folder / "back.dcm").write_bytes(stored[0])
    verdict = None
    if shutil.which("dciodvfy"):
        done = subprocess.run(["dciodvfy", folder / "back.dcm"], capture_output=True, text=True)
        verdict = [line for line in done.stderr.splitlines() if line.startswith("Error")]
    return {
        "voxels": np.array_equal(of_archive.voxels, of_folder.voxels),
        "affine": np.array_equal(of_archive.affine, of_folder.affine),
        "certificate": of_archive.report == of_folder.report,
        "store": code,
        "models": len(stored),
        "stl": model.EncapsulatedDocument[: model.EncapsulatedDocumentLength] == mesh.read_bytes(),
        "dciodvfy": verdict,
    }


if __name__ == "__main__":
    _folder = Path(sys.argv[2])
    _server = _start(_folder)
    try:
        print(json.dumps(compare(Path(sys.argv[1]), _folder)))
    finally:
        _server.terminate()
        _server.wait()
