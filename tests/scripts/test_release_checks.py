"""scripts/release_checks.py: what it lists is there, and a check that fails is named."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import pytest
import release_checks
from house import ROOT
from refusals import refused
from release_checks import CHECKS, ReleaseCheck


def test_every_check_is_a_program_of_the_project(capsys: pytest.CaptureFixture[str]) -> None:
    for check in CHECKS.values():
        path = ROOT / check.command[0]
        assert path.is_file() and (path.suffix == ".py" or os.access(path, os.X_OK))
    assert release_checks.main(["--list"]) == 0
    said = capsys.readouterr().out
    assert all(f"{name}: {check.holds}" in said for name, check in CHECKS.items())
    assert "CLRECON_RELEASE_TESTS=1 CLRECON_COVERAGE=1 .ci/run" in said


def test_a_check_that_fails_is_named_and_the_others_run(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    made = {}
    for name, code in {"bad": 1, "good": 0}.items():
        path = tmp_path / f"{name}.py"
        path.write_text(f"import os, sys\nprint(os.environ['OF_CHECK'])\nsys.exit({code})\n")
        made[name] = ReleaseCheck(f"holds {name}", (str(path),), {"OF_CHECK": name})
    main = partial(release_checks.main, checks=made, kept=tmp_path / "kept")
    assert main([]) == 1
    said = capfd.readouterr()
    assert sorted(said.out.splitlines()) == sorted(["== bad: holds bad", "bad", "== good: holds good", "good"])
    assert said.err == "failed: bad\n"
    assert main(["good"]) == 0
    with refused(SystemExit, 2):
        release_checks.main(["none"])
