"""``python -m clrecon``: the same as the console script."""

from clrecon.cli.main import run

run()
