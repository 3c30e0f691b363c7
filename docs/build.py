"""Write what pages take from tables and records; check that links between pages lead somewhere.

python docs/build.py            fills the marked blocks of docs/metrics.md
python docs/build.py --check    changes nothing; ends with 1 where a page is not up to date

A block stands between `<!-- NAME -->` and `<!-- end of NAME -->`; the rest is written by hand.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from commonmap.metrics.table import METRICS
from commonmap.study.metrics_report import markdown_answer, markdown_tables

ROOT = Path(__file__).resolve().parent.parent
STUDY = ROOT / "benchmarks" / "records" / "study-metrics"
LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)[^)]*\)")


def main() -> int:
    """Build or check the pages; return the exit code."""
    path = ROOT / "docs" / "metrics.md"
    there = path.read_text(encoding="utf-8")
    text = fill(there, "table of metrics", metrics_table())
    text = fill(text, "answer", markdown_answer(STUDY))
    text = fill(text, "results", markdown_tables(STUDY))
    if "--check" in sys.argv:
        if there != text:
            print("docs/metrics.md is not up to date: run `make docs`")
            return 1
    else:
        path.write_text(text, encoding="utf-8")
    broken = broken_links()
    for line in broken:
        print(line)
    print(f"{len(METRICS)} metrics on the page, {len(broken)} broken links")
    return 1 if broken else 0


def fill(page: str, name: str, block: str) -> str:
    """Return the page with the block of that name replaced; it must be there once."""
    start, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    if page.count(start) != 1 or page.count(end) != 1:
        raise SystemExit(f"the page must hold {start} and {end} once each")
    before, after = page.split(start)[0], page.split(end)[1]
    return f"{before}{start}\n\n{block}\n\n{end}{after}"


def metrics_table() -> str:
    """Return a table with a row for each row of `METRICS`."""
    lines = [
        "| name | metric | family | formula | better | reference |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in METRICS.items():
        formula = row.formula.replace("|", "\\|")
        better = "more" if row.maximise else "less"
        lines.append(
            f"| `{name}` | {row.title} | {row.family} | {formula} | {better} | {row.reference} |"
        )
    return "\n".join(lines)


def broken_links() -> list[str]:
    """Return a line for each link to a file that is not there."""
    broken = []
    for page in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]:
        for target in LINK.findall(page.read_text(encoding="utf-8")):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page.relative_to(ROOT)}: no such file {target}")
    return broken


if __name__ == "__main__":
    sys.exit(main())
