"""Folders of built kernels: drivers work, with one warning, where they cannot be used or trusted."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import subprocess
import sys
from contextlib import contextmanager
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

SUM_ON_DEVICE = """
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
def test_cache_folder_that_cannot_be_used_leaves_one_warning_and_no_file(device, variables, fault, tmp_path):
    command = [sys.executable, "-c", SUM_ON_DEVICE, str(device.index)]
    environment = environment_of(tmp_path, **variables)
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)

    own = [line for line in done.stderr.splitlines() if not line.startswith("MESA: ")]  # a driver's own words
    assert (done.returncode, own) == (0, [])
    total, [warning] = json.loads(done.stdout)
    assert total == 0 + 1 + 2 + 3 + 4
    assert warning == f"caches of built kernels are not used, every process builds them anew: {fault}"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", daily(2, ["devices", "render", "mesh"]))
@pytest.mark.fault_row(59)
def test_devices_render_and_mesh_warn_once_of_an_unsafe_cache_folder(command, device, tmp_path, phantom_folder):
    """The folder of pickles is refused; kernels are found as ever, so that nothing is built for this test."""
    make_faulty(tmp_path / "home" / "pytools", fault="others")
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
def test_report_of_the_selftest_has_the_warnings_of_its_device(device):
    from clrecon.opencl import list_devices
    from clrecon.proof.run import run_device_selftest

    list_devices()[device.index].remark("a remark")
    assert "a remark" in run_device_selftest(str(device.index), checks=())["warnings"]


@pytest.mark.fault_row(59)
def test_report_of_the_devices_has_their_warnings(device):
    from clrecon.jobs.devices import survey_devices

    device.remark("a remark")
    report, _ = survey_devices(str(device.index))
    assert "a remark" in report["warnings"]


@pytest.mark.fault_row(59)
def test_report_of_a_slice_has_the_warnings_of_its_device_once(device):
    from clrecon.geometry import Volume
    from clrecon.operators.reformat.cut import cut_slice

    device.remark("a remark")
    volume = Volume(np.zeros((3, 3, 3), np.int16), np.eye(4))
    assert cut_slice(volume, "axial", device=device).report["warnings"].count("a remark") == 1


@pytest.mark.fault_row(59)
def test_report_of_the_bench_has_the_warnings_of_its_devices(device):
    from clrecon.geometry import Volume
    from clrecon.proof.bench import _collect_warnings

    device.remark("a remark")
    measured = {"free_cores": 2.0, "cores": 2, "devices": []}
    volume = Volume(np.zeros((3, 3, 3), np.int16), np.eye(4))
    assert "a remark" in _collect_warnings(measured, volume, [device])


@pytest.fixture(scope="module")
def phantom_folder(shared_folder):
    """A series of 24 slices of a sphere."""
    from clrecon.proof.phantom import PhantomSettings, write_phantom

    def make(folder):
        write_phantom(folder, PhantomSettings(kind="sphere", size=(24, 24), slices=24))

    return make_once(shared_folder, "phantom-of-caches", make)


@pytest.mark.every_device
def test_cache_folders_that_can_be_used_give_no_warning(device):
    assert cache_warnings() == ()
    assert device.warnings == []


@pytest.fixture
def prepare_fresh_caches(tmp_path, monkeypatch):
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


def test_pocl_caches_its_kernels_below_the_users_cache_folder(prepare_fresh_caches, tmp_path):
    caches = prepare_fresh_caches()
    assert caches.pocl == tmp_path / "home" / "pocl" / "clrecon"
    assert caches.is_lasting
    assert caches.warnings == ()


def test_process_that_inherits_pocl_cache_dir_uses_the_same_folders(prepare_fresh_caches):
    caches = prepare_fresh_caches()  # sets POCL_CACHE_DIR
    assert prepare_fresh_caches() == caches


def test_pocl_caches_its_kernels_below_the_folder_that_pocl_cache_dir_names(
    prepare_fresh_caches, tmp_path, monkeypatch
):
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "named"))
    assert prepare_fresh_caches().pocl == tmp_path / "named" / "clrecon"


@contextmanager
def umask(bits):
    before = os.umask(bits)
    try:
        yield
    finally:
        os.umask(before)


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.fault_row(72)
def test_cache_folders_are_for_their_owner_alone_even_with_umask_0(prepare_fresh_caches, tmp_path):
    with umask(0):
        caches = prepare_fresh_caches()
    made = [path for path in tmp_path.rglob("*") if path.is_dir()]
    assert caches.pocl in made and caches.binaries in made
    assert {mode_of(path) for path in made} == {0o700}


@pytest.mark.fault_row(72)
def test_private_folders_can_be_made_with_a_umask_that_takes_every_right(tmp_path):
    with umask(0o777):
        make_private(tmp_path / "outer" / "inner")
    assert mode_of(tmp_path / "outer" / "inner") == 0o700


def make_faulty(folder, fault):
    """Make the folder of a cache with one of `FAULTS`."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if fault == "link":
        (folder.parent / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to("elsewhere")
    elif fault == "file":
        folder.write_bytes(b"")
    else:
        folder.mkdir()
        if fault == "owner":
            other_user = 4711
            os.chown(folder, other_user, -1)
        else:
            folder.chmod(0o770 if fault == "group" else 0o777)


FAULTS = {
    "link": "is a link to another place",
    "file": "is no folder|cannot be written",
    "group": r"can be written by other users \(mode 0770; chmod go-w ends that\)",
    "others": r"can be written by other users \(mode 0777",
    "owner": "belongs to another user",
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("place", ["home/pocl", "home/pocl/clrecon", "named", "named/clrecon"])
@pytest.mark.fault_row(59)
def test_folder_that_another_user_may_have_prepared_is_replaced_by_a_private_one_with_a_warning(
    prepare_fresh_caches, tmp_path, monkeypatch, place, fault
):
    if fault == "owner" and os.getuid():
        pytest.skip("only root can give a folder away")
    (tmp_path / "home").mkdir(mode=0o700)
    make_faulty(tmp_path / place, fault)
    if place.startswith("named"):
        monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "named"))

    caches = prepare_fresh_caches()

    [warning] = caches.warnings
    assert re.search(FAULTS[fault], warning)
    assert not caches.is_lasting
    assert not caches.pocl.is_relative_to(tmp_path / "home")
    assert os.environ["POCL_CACHE_DIR"] == str(caches.pocl)
    assert [mode_of(caches.pocl.parent), mode_of(caches.pocl)] == [0o700, 0o700]


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
def test_cache_folder_that_depends_on_the_current_one_is_not_used(
    prepare_fresh_caches, tmp_path, monkeypatch, variables, name
):
    monkeypatch.chdir(tmp_path)
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)

    caches = prepare_fresh_caches()

    [warning] = caches.warnings
    assert warning.endswith(f"anew: {name} is no absolute path")
    assert caches.refusal == ""
    assert not caches.is_lasting
    assert caches.binaries is None
    assert os.environ["PYOPENCL_NO_CACHE"] == "1"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("home", ["relative", ""])
def test_empty_variable_of_the_cache_folder_is_unset(prepare_fresh_caches, monkeypatch, home):
    """Mesa would make a folder without a name."""
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", home)
    prepare_fresh_caches()
    assert os.environ.get("XDG_CACHE_HOME") != ""


@pytest.mark.fault_row(59)
def test_caches_of_pyopencl_mesa_and_binaries_are_switched_off_where_other_users_can_write(
    prepare_fresh_caches, tmp_path
):
    for place in ("pytools", "mesa_shader_cache", "clrecon/kernels"):
        make_faulty(tmp_path / "home" / place, fault="others")

    caches = prepare_fresh_caches()

    [warning] = caches.warnings
    assert warning.count("mode 0777") == 3  # one for each of the folders
    assert os.environ["PYOPENCL_NO_CACHE"] == "1"
    assert os.environ["MESA_SHADER_CACHE_DISABLE"] == "true"
    assert caches.binaries is None
    assert caches.is_lasting  # PoCL's own folder is in order


@pytest.mark.fault_row(59)
def test_folder_in_one_that_other_users_can_write_to_is_at_fault_unless_its_sticky_bit_is_set(tmp_path):
    tmp_path.chmod(0o777)
    assert find_fault(tmp_path / "pocl") == "lies in a folder that other users can write to"
    tmp_path.chmod(0o1777)  # as /tmp: only the owner of a file can replace it
    assert find_fault(tmp_path / "pocl") == ""


def disk_with_free_bytes(free_bytes):
    """The module shutil on a disk on which a folder has `free_bytes(folder)`."""
    disk_usage = lambda folder: SimpleNamespace(free=free_bytes(folder))  # noqa: E731
    return SimpleNamespace(disk_usage=disk_usage, rmtree=shutil.rmtree)


@pytest.mark.fault_row(59)
def test_cache_folder_with_less_than_64_mib_free_is_not_used(prepare_fresh_caches, monkeypatch):
    elsewhere_enough = disk_with_free_bytes(lambda folder: (63 if "home" in folder.parts else 64) << 20)
    monkeypatch.setattr(cache, "shutil", elsewhere_enough)

    caches = prepare_fresh_caches()

    [warning] = caches.warnings
    assert warning.endswith("XDG_CACHE_HOME has room for 63 MiB, and 64 MiB are needed")
    assert caches.refusal == ""
    assert not caches.is_lasting
    assert caches.binaries is None


@pytest.mark.fault_row(59)
def test_kernels_are_refused_where_no_folder_has_room_for_them(prepare_fresh_caches, monkeypatch):
    monkeypatch.setattr(cache, "shutil", disk_with_free_bytes(lambda folder: 0))
    caches = prepare_fresh_caches()
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    with refused(DeviceError, 0, "MiB"):
        refuse_short_files()


@pytest.mark.parametrize(
    ("ulimit", "cause"), daily_rows(1, [("-f 100", "files may have 0.10 MB here"), ("-v 500000", "may take 0.51 GB")])
)  # in blocks of 1024 bytes
@pytest.mark.fault_row(59)
def test_error_under_a_limit_of_the_process_names_the_limit(ulimit, cause, device, tmp_path):
    python = [sys.executable, "-c", SUM_ON_DEVICE, str(device.index)]
    command = ["bash", "-c", f'ulimit {ulimit}; exec "$@"', "bash", *python]
    done = subprocess.run(command, env=environment_of(tmp_path), capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert cause in done.stderr.splitlines()[-1]


def test_folder_to_which_a_driver_still_writes_is_removed_at_the_third_try(tmp_path):
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
    assert len(removed) == 3
    assert not folder.exists()


def import_pyopencl_with_switch(switch, folder):
    """Import pyopencl in a process whose variable PYOPENCL_NO_CACHE is `switch`."""
    code = "from clrecon.opencl.quirks import import_pyopencl; import_pyopencl()"
    environment = environment_of(folder, PYOPENCL_NO_CACHE=switch)
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("switch", daily(2, ["", " ", "1"]))
def test_valid_switch_of_the_pyopencl_cache_is_accepted_in_silence(switch, tmp_path):
    done = import_pyopencl_with_switch(switch, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.release
def test_invalid_switch_of_the_pyopencl_cache_is_named(tmp_path):
    assert "PYOPENCL_NO_CACHE is 'maybe'" in import_pyopencl_with_switch("maybe", tmp_path).stderr


@pytest.mark.parametrize("name", quirks._THREAD_COUNTS)
@pytest.mark.parametrize(
    "told", ["-1", "x", "2.5", "4097", "4294967297", pytest.param("9" * 5000, id="5000 digits"), "\udcff"]
)
def test_invalid_number_of_driver_threads_is_refused_with_the_largest_of_4096(name, told, monkeypatch):
    monkeypatch.setenv(name, told)
    with refused(DeviceError, name, 4096) as caught:
        quirks.import_pyopencl.__wrapped__()
    assert_one_line(caught.value, letters=250)


@pytest.mark.parametrize("told", ["", " ", "0", " 2 ", "+3", "4096"])
def test_valid_number_of_driver_threads_is_kept_and_an_empty_one_unset(told, monkeypatch):
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", told)
    quirks.import_pyopencl.__wrapped__()
    assert os.environ.get("POCL_MAX_PTHREAD_COUNT") == (told if told.strip() else None)
