"""All steps in one call: adjust, correct, clean, grid, compare, draw the map, report."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.errors import SettingError
from pcfix.flow import run_steps
from pcfix.flow.record import Record
from pcfix.flow.request import Files, Request, since
from pcfix.flow.run_steps import Run, Step, adjusted_words
from pcfix.flow.runner import Bar, no_bar
from pcfix.flow.shore import check_shoreline
from pcfix.flow.tiles import check_folder
from pcfix.io.tiles import Tiles, check_one_file

RECORD = "run.json"
STEPS = (
    Step("adjust", "Adjusting", run_steps.adjust, run_steps.outputs_of_adjust),
    Step("correct", "Correcting", run_steps.correct, run_steps.outputs_of_correct),
    Step("clean", "Cleaning", run_steps.clean, lambda run: run.files.parts(run.files.cleaned)),
    Step("dsm", "Gridding", run_steps.grid, run_steps.outputs_of_grid),
    Step(
        "compare", "Comparing", run_steps.compare,
        lambda run: [run.files.compare / "compare.json"],
        lambda run: "" if run.request.reference is None else None,
    ),
    Step(
        "map", "Drawing the map", run_steps.draw_map,
        lambda run: [run.files.map], run_steps.why_no_map,
    ),
    Step("report", "Writing the report", run_steps.report, lambda run: [run.files.report]),
)  # fmt: skip
"""In their order; each depends on those before it."""


def run_all(
    request: Request,
    out_dir: Path,
    *,
    overwrite: bool = False,
    jobs: int | None = None,
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
) -> Path:
    """Do every step that is not done yet, and return the path of the report.

    A run with the same request resumes in its folder; if only options of later steps changed, such
    as the reference, only these steps are done again. `overwrite` replaces a cloud that was
    corrected in another way, and what else is in the folder. `say` gets a line for each step, `bar`
    shows its progress.
    """
    inputs = [path for some in request.files().values() for path in some]
    files = Files(out_dir, request.source)
    if request.m3c2:
        load_py4dgeo()
    check_one_file(request.source, request)
    if isinstance(request.source, Tiles):
        check_folder(files.corrected, request.source)
    record = _opened(request, out_dir, overwrite)
    check_shoreline(request.shoreline, overwrite=overwrite or record.resumes, inputs=inputs)
    run = Run(request, files, tuple(inputs), jobs)
    for step in STEPS:
        why_not = step.why_not(run)
        if why_not:
            say(f"{step.name:<9} not written: {why_not}")
        if why_not is not None:
            continue
        with bar(step.title) as progress:
            outputs = step.outputs(run)
            work = partial(step.work, run, progress)
            result, was_done = record.step(step.name, outputs, work)
        was_said = run.says_adjusted
        run = run.after(step.name, result)
        if run.says_adjusted and not was_said:
            for line in adjusted_words(run, was_done):
                say(line)
        if step.name != "adjust":
            shown = {"correct": files.corrected, "clean": files.cleaned}.get(step.name, outputs[0])
            done = "done before" if was_done else "done"
            say(f"{step.name:<9} {done}: {shown}{run_steps.words_of(step.name, run)}")
    return files.report


def _opened(request: Request, out_dir: Path, overwrite: bool) -> Record:
    """Return the record of a folder, made where it is missing; refuse one of another run."""
    if not out_dir.parent.is_dir():
        raise SettingError(
            "output.no_folder",
            f"{out_dir}: the folder {out_dir.parent} does not exist. Make it first.",
            path=out_dir,
        )
    out_dir.mkdir(exist_ok=True)
    record = Record(out_dir / RECORD, request.record(), request.watched(out_dir), since)
    if not (overwrite or record.resumes) and any(out_dir.iterdir()):
        changed = ", ".join(record.changed) or "input file, or other files"
        raise SettingError(
            "run.other",
            f"{out_dir}: holds a run with another {changed}. Add --overwrite to replace it, or give"
            " another folder.",
            path=out_dir,
            changed=record.changed,
        )
    return record
