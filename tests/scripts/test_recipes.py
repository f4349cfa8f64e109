"""The recipes of docs/scale.md for schedulers, run dry: which parts they ask for, and what they make of exit codes."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from house import ROOT

from clrecon.errors import PARTLY_DONE

RECIPES = (ROOT / "docs" / "scale.md").read_text(encoding="utf-8")


def find_recipe(language: str, word: str) -> str:
    """Return the block of code in this language that has the word."""
    blocks = re.findall(rf"```{language}\n(.*?)```", RECIPES, re.DOTALL)
    (block,) = [block for block in blocks if word in block]
    return str(block)


def find_kubernetes_command() -> str:
    """Return the shell command of the indexed job, which stands as a folded text; its folder is the current one."""
    folded = find_recipe("yaml", "completionMode: Indexed").partition("- >-\n")[2].partition("resources:")[0]
    return " ".join(folded.split()).replace("cd /data && ", "")


def find_nextflow_command() -> str:
    """Return the script of a part as bash gets it, but for its variables, which Nextflow puts in before."""
    script = find_recipe("groovy", "process part").partition('script:\n    "')[2].partition('"\n')[0]
    return script.replace("$base/", "").replace("\\$", "$")


SHELL_RECIPES = {
    "Slurm": (find_recipe("bash", "#SBATCH"), {"SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_COUNT": "40"}),
    "Kubernetes": (find_kubernetes_command(), {"JOB_COMPLETION_INDEX": "6"}),
    "Nextflow": (find_nextflow_command(), {"i": "7"}),
}


def run_dry(recipe: str, folder: Path, code: int) -> tuple[int, list[str]]:
    """Run a recipe with a clrecon that only notes its arguments and ends with `code`; return its own and these."""
    script, variables = SHELL_RECIPES[recipe]
    for name, text in {"clrecon": f'echo "$@" >> "{folder}/asked"; exit {code}', "srun": 'exec "$@"'}.items():
        (folder / name).write_text(f"#!/bin/sh\n{text}\n")
        (folder / name).chmod(0o755)
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "SLURM_CPUS_PER_TASK": "4", **variables}
    done = subprocess.run(["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.stderr == ""
    return done.returncode, (folder / "asked").read_text().splitlines()


@pytest.mark.skipif(os.name == "nt", reason="sh")
@pytest.mark.parametrize("recipe", SHELL_RECIPES)
@pytest.mark.parametrize(("code", "expected"), [(0, 0), (PARTLY_DONE, 0), (6, 1)])
def test_recipe_asks_for_its_part_and_fails_only_where_the_part_is_to_run_again(
    recipe: str, code: int, expected: int, tmp_path: Path
) -> None:
    ended, asked = run_dry(recipe, tmp_path, code)
    assert ended == expected
    assert asked == ["batch cohort.csv -o OUT --hu 300 --part 7/40 --resume -q"]


@pytest.mark.parametrize("language", ["snakemake", "groovy"])
def test_recipe_of_a_workflow_makes_parts_and_collects_them(language: str) -> None:
    recipe = find_recipe(language, "clrecon batch")
    assert len(re.findall(r"--part \S+/(?:40|\{PARTS\}) --resume -q \|\| \[ \\?\$\? = 8 \]", recipe)) == 1
    assert len(re.findall(r"--collect -q \|\| \[ \\?\$\? = 8 \]", recipe)) == 1
