"""Nothing that clrecon reads is run as code."""

from __future__ import annotations

import ast
import re

import pytest
from house import ROOT

RUNS_CODE = {"eval", "exec", "compile", "__import__"}
UNPICKLES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "yaml"}
_WORDS = re.compile(rf"\b(?:{'|'.join(sorted(RUNS_CODE | UNPICKLES))}|allow_pickle|load)\b")
MODULES = sorted((ROOT / "clrecon").rglob("*.py"))


def find_unsafe(source: str) -> list[str]:
    """Calls that run what they are given as code."""
    if not _WORDS.search(source):
        return []
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            found += [f"import {name}" for name in names if name.partition(".")[0] in UNPICKLES]
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name) and node.func.id in RUNS_CODE:
            found.append(node.func.id)
        pickles = [word.value for word in node.keywords if word.arg == "allow_pickle"]
        if any(not isinstance(value, ast.Constant) or value.value is not False for value in pickles):
            found.append("allow_pickle")
        name = ast.unparse(node.func)
        if name in ("np.load", "numpy.load") and not pickles:
            found.append("np.load without allow_pickle=False")
    return found


@pytest.mark.fault_row(71)
def test_no_module_of_clrecon_calls_what_runs_its_input_as_code() -> None:
    assert len(MODULES) > 300  # all of clrecon, not one folder of it: counted 431
    found = {path.relative_to(ROOT).as_posix(): find_unsafe(path.read_text()) for path in MODULES}
    assert {path: calls for path, calls in found.items() if calls} == {}


@pytest.mark.parametrize(
    ("source", "unsafe"),
    [
        ("eval('1')", ["eval"]),
        ("import pickle", ["import pickle"]),
        ("from yaml import load", ["import yaml"]),
        ("np.load(path)", ["np.load without allow_pickle=False"]),
        ("np.load(path, allow_pickle=True)", ["allow_pickle"]),
        ("np.load(path, allow_pickle=asked)", ["allow_pickle"]),
        ("np.load(path, allow_pickle=False)", []),
        ("re.compile('a')", []),
        ("json.loads(text)", []),
    ],
)
def test_call_or_import_that_may_run_its_input_as_code_is_found(source: str, unsafe: list[str]) -> None:
    assert find_unsafe(source) == unsafe
