"""Write the pages that are made from tables; check that links between pages lead somewhere.

python docs/build.py            writes docs/metrics.md
python docs/build.py --check    changes nothing; ends with 1 where a page is not up to date
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from commonmap.metrics.table import METRICS

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)[^)]*\)")


def main() -> int:
    """Build or check the pages; return the exit code."""
    path = ROOT / "docs" / "metrics.md"
    text = metrics_page()
    if "--check" in sys.argv:
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            print("docs/metrics.md is not up to date: run `make docs`")
            return 1
    else:
        path.write_text(text, encoding="utf-8")
    broken = broken_links()
    for line in broken:
        print(line)
    print(f"{len(METRICS)} metrics on the page, {len(broken)} broken links")
    return 1 if broken else 0


def metrics_page() -> str:
    """Return docs/metrics.md, a row for each row of the table."""
    lines = [
        "# Similarity metrics",
        "",
        "Made by `make docs` from `commonmap.metrics.table.METRICS`. `P` and `Q` (or `a` and `b`)",
        "are the heights of source and target on the cells that both know, normalised as",
        "`search.normalise` says.",
        "",
        "| name | metric | family | formula | better | reference |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in METRICS.items():
        formula = row.formula.replace("|", "\\|")
        better = "more" if row.maximise else "less"
        lines.append(
            f"| `{name}` | {row.title} | {row.family} | {formula} | {better} | {row.reference} |"
        )
    return "\n".join(lines) + "\n"


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
