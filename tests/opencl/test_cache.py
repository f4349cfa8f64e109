"""Folders of built kernels: drivers work, with one warning, where they cannot be used or trusted."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from made_once import make_once
from refusals import assert_one_line, refused
from variants import FOR_RELEASE, daily, daily_rows

from clrecon.errors import DeviceError
from clrecon.opencl import cache, quirks
from clrecon.opencl.cache import cache_warnings, find_fault, make_private, prepare_caches, refuse_short_files

VARIABLES = ("XDG_CACHE_HOME", "POCL_CACHE_DIR", "PYOPENCL_NO_CACHE", *cache._MESA_OFF)

CODE = """
import json, sys
import numpy as np
import clrecon
from clrecon.opencl import upload
from clrecon.operators.primitives.scan import exclusive_scan
device = clrecon.device(int(sys.argv[1]))
total = exclusive_scan(device, upload(device, np.arange(5, dtype=np.uint32)), 5).total
print(json.dumps([total, device.warnings]))
"""


def environment_of(tmp_path, **variables):
    environment = {key: text for key, text in os.environ.items() if key not in VARIABLES}
    return {**environment, "TMPDIR": str(tmp_path), **variables}


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(
    ("variables", "fault"),
    [
        ({"HOME": "/proc/nowhere"}, "~/.cache cannot be written"),
        *(
            pytest.param(variables, fault, marks=[pytest.mark.first_device, FOR_RELEASE])  # found without a device
            for variables, fault in (
                ({"HOME": "/dev/null", "XDG_CACHE_HOME": "relative"}, "XDG_CACHE_HOME is no absolute path"),
                ({"POCL_CACHE_DIR": "/proc/nowhere"}, "POCL_CACHE_DIR cannot be written"),
                ({"POCL_CACHE_DIR": ""}, "POCL_CACHE_DIR is set to nothing"),
            )
        ),
    ],
)
@pytest.mark.fault_row(59)
def test_missing_place_for_built_kernels_is_warned_of(device, variables, fault, tmp_path):
    command = [sys.executable, "-c", CODE, str(device.index)]
    environment = environment_of(tmp_path, **variables)
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    own = [line for line in done.stderr.splitlines() if not line.startswith("MESA: ")]  # a driver's own words
    assert (done.returncode, own) == (0, [])
    total, [warning] = json.loads(done.stdout)
    assert total == 10
    assert warning == f"caches of built kernels are not used, every process builds them anew: {fault}"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", daily(2, ["devices", "render", "mesh"]))
@pytest.mark.fault_row(59)
def test_every_command_with_a_device_warns_once(command, device, tmp_path, phantom_folder):
    """The folder of pickles is refused; kernels are found as ever, so that nothing is built for this test."""
    spoil(tmp_path / "home" / "pytools", "others")
    arguments = {
        "devices": [],
        "mesh": [str(phantom_folder), "-o", str(tmp_path / "a.stl"), "--hu", "300"],
        "render": [str(phantom_folder), "-o", str(tmp_path / "a.png"), "--mode", "slice", "--size", "32"],
    }[command]
    kernels = {"POCL_CACHE_DIR": str(prepare_caches().pocl)}
    environment = environment_of(tmp_path, XDG_CACHE_HOME=str(tmp_path / "home"), **kernels)
    line = [sys.executable, "-m", "clrecon.cli.main", command, *arguments, "--device", str(device.index)]
    done = subprocess.run(line, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("XDG_CACHE_HOME/pytools can be written by other users") == 1, done.stderr


@pytest.mark.fault_row(59)
def test_reports_of_other_commands_and_pictures_have_the_warnings(device):
    from clrecon.geometry import Volume
    from clrecon.jobs import devices
    from clrecon.operators.reformat.cut import cut_slice
    from clrecon.proof import bench as bench_job
    from clrecon.proof import run

    device.remark("a remark")
    assert "a remark" in run.run_device_selftest(str(device.index), checks=())["warnings"]
    assert "a remark" in devices.survey_devices(str(device.index))[0]["warnings"]
    volume = Volume(np.zeros((3, 3, 3), np.int16), np.eye(4))
    assert cut_slice(volume, "axial", device=device).report["warnings"].count("a remark") == 1
    result = {"free_cores": 2.0, "cores": 2, "devices": []}
    assert "a remark" in bench_job._collect_warnings(result, volume, [device])


@pytest.fixture(scope="module")
def phantom_folder(shared_folder):
    from clrecon.proof.phantom import PhantomSettings, write_phantom

    def make(folder):
        write_phantom(folder, PhantomSettings(kind="sphere", size=(24, 24), slices=24))

    return make_once(shared_folder, "phantom-of-caches", make)


@pytest.mark.every_device
def test_a_cache_that_works_is_no_warning(device):
    assert cache_warnings() == () and device.warnings == []


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """`prepare_caches` as in a new process, whose caches lie in `tmp_path`."""
    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # what was not there is noted too, and taken away in the end
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    leaving = []
    monkeypatch.setattr(cache, "atexit", SimpleNamespace(register=lambda *call: leaving.append(call)))
    yield cache.prepare_caches.__wrapped__
    for remove, folder in leaving:
        remove(folder)
        assert not os.path.exists(folder)


def test_good_folders_are_used_as_they_are(fresh, tmp_path, monkeypatch):
    caches = fresh()
    assert caches.warnings == () and caches.is_lasting
    assert caches.pocl == tmp_path / "home" / "pocl" / "clrecon"
    assert fresh() == caches  # a process that inherits POCL_CACHE_DIR
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "named"))
    assert fresh().pocl == tmp_path / "named" / "clrecon"


@pytest.mark.fault_row(72)
def test_folders_of_caches_are_private_whatever_the_umask(fresh, tmp_path):
    before = os.umask(0)
    try:
        caches = fresh()
    finally:
        os.umask(before)
    made = [path for path in tmp_path.rglob("*") if path.is_dir()]
    assert caches.pocl in made and caches.binaries in made
    assert {stat.S_IMODE(path.stat().st_mode) for path in made} == {0o700}
    os.umask(0o777)
    try:
        make_private(tmp_path / "odd" / "umask")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "odd" / "umask").stat().st_mode) == 0o700


def spoil(folder, how):
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if how == "link":
        (folder.parent / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to("elsewhere")
    elif how == "file":
        folder.write_bytes(b"")
    else:
        folder.mkdir()
        if how == "owner":
            os.chown(folder, 4711, -1)
        else:
            folder.chmod(0o770 if how == "group" else 0o777)


FAULTS = {
    "link": "is a link to another place",
    "file": "cannot be written",
    "group": r"can be written by other users \(mode 0770; chmod go-w ends that\)",
    "others": r"can be written by other users \(mode 0777",
    "owner": "belongs to another user",
}


@pytest.mark.parametrize("how", FAULTS)
@pytest.mark.parametrize("place", ["home/pocl", "home/pocl/clrecon", "named", "named/clrecon"])
@pytest.mark.fault_row(59)
def test_a_folder_that_another_user_prepared_is_not_loaded(fresh, tmp_path, monkeypatch, place, how):
    if how == "owner" and os.getuid():
        pytest.skip("only root can give a folder away")
    (tmp_path / "home").mkdir(mode=0o700)
    spoil(tmp_path / place, how)
    if place.startswith("named"):
        monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "named"))
    caches = fresh()
    [warning] = caches.warnings
    assert re.search(FAULTS[how] if how != "file" else "is no folder|cannot be written", warning)
    assert not caches.is_lasting and not caches.pocl.is_relative_to(tmp_path / "home")
    assert os.environ["POCL_CACHE_DIR"] == str(caches.pocl)
    assert stat.S_IMODE(caches.pocl.parent.stat().st_mode) == stat.S_IMODE(caches.pocl.stat().st_mode) == 0o700


@pytest.mark.parametrize(
    ("variables", "name"),
    [
        ({"XDG_CACHE_HOME": "relative"}, "XDG_CACHE_HOME"),
        ({"XDG_CACHE_HOME": " "}, "XDG_CACHE_HOME"),
        ({"XDG_CACHE_HOME": "", "HOME": "relative"}, "~/.cache"),
        ({"XDG_CACHE_HOME": "", "HOME": ""}, "~/.cache"),
    ],
)
@pytest.mark.fault_row(59)
def test_a_folder_that_depends_on_the_current_one_is_not_used(fresh, tmp_path, monkeypatch, variables, name):
    """Libraries look for their caches elsewhere then."""
    monkeypatch.chdir(tmp_path)
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    caches = fresh()
    [warning] = caches.warnings
    assert warning.endswith(f"anew: {name} is no absolute path") and not caches.refusal
    assert not caches.is_lasting and caches.binaries is None and os.environ["PYOPENCL_NO_CACHE"] == "1"
    assert not list(tmp_path.iterdir())
    assert os.environ.get("XDG_CACHE_HOME") != "", "Mesa would make a folder without a name"


@pytest.mark.fault_row(59)
def test_the_other_caches_are_switched_off_one_by_one(fresh, tmp_path):
    for place in ("pytools", "mesa_shader_cache", "clrecon/kernels"):
        spoil(tmp_path / "home" / place, "others")
    caches = fresh()
    [warning] = caches.warnings
    assert warning.count("mode 0777") == 3
    assert caches.is_lasting and caches.binaries is None
    assert os.environ["PYOPENCL_NO_CACHE"] == "1" and os.environ["MESA_SHADER_CACHE_DISABLE"] == "true"


@pytest.mark.fault_row(59)
def test_a_folder_that_others_can_replace_is_not_trusted(tmp_path):
    tmp_path.chmod(0o777)
    assert find_fault(tmp_path / "pocl") == "lies in a folder that other users can write to"
    tmp_path.chmod(0o1777)
    assert find_fault(tmp_path / "pocl") == ""


@pytest.mark.fault_row(59)
def test_a_folder_without_room_is_not_used(fresh, monkeypatch):
    def disk_usage(folder):
        return SimpleNamespace(free=63 << 20 if "home" in folder.parts else 64 << 20)

    monkeypatch.setattr(cache, "shutil", SimpleNamespace(disk_usage=disk_usage, rmtree=shutil.rmtree))
    caches = fresh()
    [warning] = caches.warnings
    assert warning.endswith("XDG_CACHE_HOME has room for 63 MiB, and 64 MiB are needed") and not caches.refusal
    assert not caches.is_lasting and caches.binaries is None


@pytest.mark.fault_row(59)
def test_no_room_anywhere_is_an_error(fresh, monkeypatch):
    room = SimpleNamespace(disk_usage=lambda folder: SimpleNamespace(free=0), rmtree=shutil.rmtree)
    monkeypatch.setattr(cache, "shutil", room)
    caches = fresh()
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    with refused(DeviceError, 0, "MiB"):
        refuse_short_files()


@pytest.mark.parametrize(
    "limit, says", daily_rows(1, [("-f 100", "files may have 0.10 MB here"), ("-v 500000", "want of memory")])
)
@pytest.mark.fault_row(59)
def test_limits_of_the_process_are_named(limit, says, device, tmp_path):
    command = ["bash", "-c", f'ulimit {limit}; exec "$@"', "bash", sys.executable, "-c", CODE, str(device.index)]
    done = subprocess.run(command, env=environment_of(tmp_path), capture_output=True, text=True)
    assert done.returncode == 1 and says in done.stderr.splitlines()[-1], done.stderr


def test_a_folder_that_a_driver_still_writes_to_is_removed(tmp_path):
    """Mesa's cache has a thread of its own: a file that appears meanwhile makes the removal of its folder fail."""
    folder = tmp_path / "built"
    folder.mkdir()
    removed = []

    def remove_all_but_a_newer_file(path, ignore_errors=False):
        removed.append(path)
        shutil.rmtree(path, ignore_errors=ignore_errors)
        if len(removed) < 3:
            folder.mkdir()
            (folder / "newer").write_bytes(b"kernel")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "shutil", SimpleNamespace(rmtree=remove_all_but_a_newer_file))
        cache._remove_tree(str(folder))
    assert len(removed) == 3 and not folder.exists()


@pytest.mark.parametrize(
    ("told", "says"), daily_rows(2, [("", ""), (" ", ""), ("1", ""), ("maybe", "PYOPENCL_NO_CACHE is 'maybe'")])
)
def test_invalid_switch_of_the_pyopencl_cache_is_named(told, says, tmp_path):
    code = "from clrecon.opencl.quirks import import_pyopencl; import_pyopencl()"
    environment = environment_of(tmp_path, PYOPENCL_NO_CACHE=told)
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert (says in done.stderr) if says else (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", quirks._THREAD_COUNTS)
@pytest.mark.parametrize("told", ["-1", "x", "2.5", "4097", "4294967297", "9" * 5000, "\udcff"])
def test_a_number_of_threads_that_ends_the_process_is_refused(name, told, monkeypatch):
    monkeypatch.setenv(name, told)
    with refused(DeviceError, name, 4096) as caught:
        quirks.import_pyopencl.__wrapped__()
    assert_one_line(caught.value, letters=250)


@pytest.mark.parametrize("told", ["", " ", "0", " 2 ", "+3", "4096"])
def test_numbers_of_threads_that_work_are_left_as_they_are(told, monkeypatch):
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", told)
    assert quirks.import_pyopencl.__wrapped__() is quirks.import_pyopencl()
    assert os.environ.get("POCL_MAX_PTHREAD_COUNT") == (told if told.strip() else None)
