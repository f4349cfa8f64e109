"""The frame of the page: its skeleton and its one style, for `string.Template`."""

from __future__ import annotations

from string import Template

__all__ = ["PAGE_TEMPLATE", "STYLE"]

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

STYLE = """
:root { color-scheme: light dark; --ink: #1a1d21; --soft: #5b6470; --faint: #8a939e; --line: #d9dde2; --back: #fcfcfb;
  --panel: #f1f2f4; --mark: #0b5fad; --bad: #a83a1e; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e6e9; --soft: #a9b1bb; --faint: #7d8793; --line: #343a42; --back: #15181c; --panel: #1e2228;
    --mark: #6cb2f5; --bad: #f08a6c; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem clamp(1rem, 3vw, 3rem) 4rem; max-width: 110rem; background: var(--back);
  color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .4rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .6rem; padding-top: .6rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p, ul { max-width: 62rem; margin: .4rem 0 .8rem; }
.lead { font-size: 1.1rem; color: var(--soft); }
.note { color: var(--soft); font-size: .9rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .7rem 1.6rem;
  margin: 1.2rem 0 0; }
.facts div { border-left: 3px solid var(--line); padding-left: .7rem; }
dt { color: var(--soft); font-size: .8rem; }
dd { margin: 0; overflow-wrap: anywhere; }
ul.findings { padding-left: 1.2rem; }
ul.findings li { margin: .35rem 0; }
.scroll { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-size: .8rem; font-variant-numeric: tabular-nums; }
th, td { padding: .36rem .34rem; text-align: right; vertical-align: top; border-bottom: 1px solid var(--line); }
th { font-weight: 600; vertical-align: bottom; }
th small, td small { display: block; font-weight: 400; color: var(--soft); font-size: .78rem; }
thead small { white-space: nowrap; }
thead th { background: var(--panel); border-bottom: 2px solid var(--line); }
th:first-child, th.words, td.words { text-align: left; }
tbody th { background: var(--back); position: sticky; left: 0; min-width: 9rem; vertical-align: top; }
td.words { min-width: 7.5rem; color: var(--soft); }
tr.peer th, tr.peer td { color: var(--faint); }
tr.group th { background: var(--panel); text-align: left; color: var(--soft); font-weight: 600; position: static; }
tr.failed td { text-align: left; color: var(--bad); }
td.best { font-weight: 700; color: var(--ink); }
td.none { color: var(--faint); }
.swatch { display: inline-block; width: .8em; height: .8em; border-radius: 2px; margin-right: .4em;
  vertical-align: -.05em;
  border: 1px solid var(--line); }
figure { margin: .8rem 0; }
figcaption { font-size: .86rem; color: var(--soft); margin-top: .3rem; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(34rem, 100%), 1fr)); gap: 1rem 2rem; }
svg { max-width: 100%; height: auto; color: var(--ink); }
svg text { font-family: inherit; }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(15rem, 100%), 1fr)); gap: 1.2rem; }
.tiles figure { margin: 0; }
.tiles img, .planes img { display: block; width: 100%; height: auto; border-radius: 4px; background: #000; }
.tiles img + img { margin-top: .4rem; }
.planes { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(26rem, 100%), 1fr)); gap: 1.2rem;
  max-width: 76rem; }
.legend { display: flex; flex-wrap: wrap; gap: .3rem 1.1rem; padding: 0; margin: .4rem 0 .8rem; list-style: none;
  font-size: .88rem; }
dl.definitions { display: grid; grid-template-columns: minmax(8rem, max-content) 1fr; gap: .3rem 1.2rem;
  font-size: .92rem;
  max-width: 76rem; }
dl.definitions dt { color: var(--ink); font-weight: 600; font-size: inherit; }
code { font-size: .92em; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); color: var(--soft); font-size: .86rem; }
@media (max-width: 40rem) {
  body { padding-top: 1rem; } h1 { font-size: 1.45rem; }
  tbody th { min-width: 7.5rem; }
  dl.definitions { grid-template-columns: 1fr; } dl.definitions dd { margin-bottom: .5rem; }
}
@media print {
  :root { color-scheme: light; --ink: #000; --soft: #333; --faint: #666; --line: #bbb; --back: #fff; --panel: #f2f2f2;
    --mark: #004a8f; --bad: #8a2a10; }
  @page { size: A4 landscape; margin: 12mm; }
  body { padding: 0; max-width: none; font-size: 10pt; }
  h2 { break-after: avoid; } figure, tr, .facts div { break-inside: avoid; }
  .scroll { overflow: visible; } table { font-size: 6.6pt; width: 100%; } th, td { padding: 1.5pt 3pt; }
  tbody th, td.words { min-width: 0; position: static; } th small, td small { font-size: 5.8pt; }
  thead small { white-space: normal; }
  .tiles { grid-template-columns: repeat(5, 1fr); } .planes { grid-template-columns: repeat(2, 1fr); max-width: 22cm; }
  .plots { grid-template-columns: repeat(2, 1fr); }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
""".strip()
