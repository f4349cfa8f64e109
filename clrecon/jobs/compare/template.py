"""The frame of the page: its skeleton for `string.Template`, and its one style."""

from __future__ import annotations

from importlib.resources import files
from string import Template

PAGE_TEMPLATE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="clrecon $version">
<title>$title</title>
<style>
$style
</style>
</head>
<body>
<header>
<h1>$title</h1>
<p class="lead">$lead</p>
<dl class="facts">
$facts
</dl>
</header>
<main>
$body
</main>
<footer>
<p>Made by clrecon $version. The numbers are in <code>report.json</code> beside this page, the pictures as PNG too.
clrecon is a research tool and no medical device.</p>
</footer>
</body>
</html>
""")


def read_style() -> str:
    """Return the style of the page, from the file beside this one."""
    return (files(__package__) / "page.css").read_text(encoding="utf-8").strip()
