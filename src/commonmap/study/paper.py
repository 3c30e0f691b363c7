"""The paper's experiment as a folder: figures, tables and a page, all or nothing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from commonmap.errors import InputError
from commonmap.io.atomic import writing_folder
from commonmap.study.claims import ReadingRow, as_record, measure_scenes, read_records, tabulate
from commonmap.study.paper_run import AREAS_READ, SECONDS, Experiment, run_experiment
from commonmap.study.paper_tables import ENTRIES, write_tables
from commonmap.types import Progress, no_progress

FIRST_SCENE = 101
"""Seed of the first of the further scenes; the run's own scene is not among them."""

MAX_SCENES = 1000


@dataclass(frozen=True, eq=False)
class PaperStudy:
    """What `study_paper` did: the run, the table of readings, the files written."""

    run: Experiment
    rows: list[ReadingRow]
    files: list[str]


def study_paper(
    out: Path,
    *,
    seed: int,
    scenes: int = 0,
    records: Path | None = None,
    seconds: float = SECONDS,
    size: float | None = None,
    areas_read: int = AREAS_READ,
    progress: Progress = no_progress,
) -> PaperStudy:
    """Run the experiment of a seed and write all of it into the folder `out`.

    scenes: further scenes, without odometry, on which the claim is tested; with none, it is tested
    on the run's own areas. records: file of raw records a scene, which is added to; scenes that
    it holds are not measured again. seconds, size, areas_read: see `run_experiment`.
    """
    if not 0 <= scenes <= MAX_SCENES:
        raise InputError(f"--scenes must lie in 0 to {MAX_SCENES}; {scenes} came")
    if records is not None and records.exists():
        read_records(records)  # a file that is none of ours is found out at once
    with writing_folder(out, replaces=ENTRIES) as part:
        # 1. the experiment of the paper, from raw logs to the common map
        run = run_experiment(
            seed, seconds=seconds, size=size, areas_read=areas_read, progress=progress
        )
        # 2. the claim: over further scenes, or on the areas of this one
        own = {"seed": seed, "areas": [as_record(item) for item in run.readings]}
        seeds = range(FIRST_SCENE, FIRST_SCENE + scenes)
        found = measure_scenes(seeds, records, areas_read=areas_read, size=size, progress=progress)
        rows = tabulate(found or [own])
        # 3. figures, tables, page
        from commonmap.study.paper_figures import draw_figures

        figures = draw_figures(run, rows, part, progress=progress)
        progress("write the results")
        write_tables(run, rows, scenes, figures, part)
        if found:
            lines = "".join(json.dumps(record, separators=(",", ":")) + "\n" for record in found)
            (part / "claims.jsonl").write_text(lines, encoding="utf-8")
        files = sorted(path.name for path in part.iterdir())
    return PaperStudy(run, rows, files)
