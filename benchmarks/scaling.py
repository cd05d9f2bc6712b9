"""Measure how the cost of every stage grows with frames, cameras and pixels.

usage: python benchmarks/scaling.py NAME CAPTURE [--synth a=b ...]

CAPTURE is the name of a shared capture, a folder, or `performer`, a synthetic capture with the settings `--synth`. Runs
the stages of preset `fast`, training limited to a number of steps, on the whole capture, and on a quarter and a half of
its frames, cameras and pixels in turn, in a new store. Writes `benchmarks/results/NAME.json`, `.md` and `.png`; the
straight lines of the chart mark proportional cost.
"""

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from peak_memory import peak_mib, reset_peak
from provenance import RESULTS, arguments, provenance, provenance_line, table, write_result
from studies import capture_folder

from flows.preparation import segment_subject
from hnerf.avatar.trained import load_avatar
from hnerf.capture.capture import Capture
from hnerf.config import load_settings
from hnerf.evenly_spaced import evenly_spaced
from hnerf.study.degradations.catalogue import Degradation
from tasks.calibration import calibrate, calibrated_capture
from tasks.capture import ingest, subset_capture
from tasks.fit import fit
from tasks.source import read_capture
from tasks.store import Artifact, Store
from tasks.study import degrade_capture
from tasks.training import train

STEPS = 60
SHARES = (0.25, 0.5)
MARKERS = "os^Dv"
Cost = tuple[float, float]  # seconds, GiB
Part = tuple[Artifact, tuple[str, ...] | None, tuple[int, ...] | None]  # training cameras and frames of a recording


def main() -> None:
    """Measure all parts, print, draw and write."""
    parser = arguments(__doc__)
    parser.add_argument("name")
    parser.add_argument("capture")
    parser.add_argument("--synth", action="append", default=[], metavar="a=b", help="of the performer")
    options = parser.parse_args()
    where = provenance()
    with tempfile.TemporaryDirectory(prefix="hnerf-scaling-") as name:
        costs = measure_parts(capture_folder(options.capture, options.synth, Path(name)), Path(name))
    result = where | {"capture": options.capture, "synth": options.synth, "steps": STEPS, "costs": costs}
    lines = [f"# Cost against frames, cameras and pixels: {options.capture}", "", provenance_line(result), ""]
    lines += [f"Seconds of a stage, and the most GiB that its process held; training: {STEPS} steps, setup and saving."]
    for axis, rows in costs.items():
        stages = list(next(iter(rows.values())))
        cells = [[str(n), *("{:.1f} s, {:.1f}".format(*row[stage]) for stage in stages)] for n, row in rows.items()]
        lines += ["", *table([[axis, *stages], *cells])]
    write_result(options.name, result, "\n".join([*lines, "", f"![seconds against size]({options.name}.png)", ""]))
    draw(costs, RESULTS / f"{options.name}.png")


def measure_parts(capture: Path, scratch: Path) -> dict[str, dict[int, dict[str, Cost]]]:
    """Return the costs by axis, amount and stage; the largest amount of each axis is the whole capture."""
    store = Store(scratch / "store")
    recording = ingest(store, read_capture(capture)[0], load_settings("fast").capture)
    recorded = Capture.load(recording.root)
    frames, cameras = recorded.train_frames, recorded.train_cameras
    shrunk = [Degradation(kind="small_images", strength=share**0.5, seed=0) for share in SHARES]
    smaller = [degrade_capture(store, recording, degradation) for degradation in shrunk]
    parts: dict[str, dict[int, Part]] = {
        "frames": {n: (recording, None, tuple(evenly_spaced(frames, n))) for n in parts_of(len(frames))},
        "cameras": {n: (recording, tuple(evenly_spaced(cameras, n)), None) for n in parts_of(len(cameras))},
        "pixels": {pixels_of(images): (images, None, None) for images in smaller},
    }
    costs = {
        axis: {amount: measure(store, subset_capture(store, *part, ())) for amount, part in by_amount.items()}
        for axis, by_amount in parts.items()
    }
    whole = measure(store, subset_capture(store, recording, None, None, ()))  # last: its memory stays allocated
    amounts = {"frames": len(frames), "cameras": len(cameras), "pixels": pixels_of(recording)}
    return {axis: rows | {amounts[axis]: whole} for axis, rows in costs.items()}


def pixels_of(recording: Artifact) -> int:
    """Return the number of pixels in an image of the first training camera."""
    capture = Capture.load(recording.root)
    return math.prod(capture.cameras[capture.train_cameras[0]].size_px)


def parts_of(whole: int) -> list[int]:
    """Return a quarter and a half of a number of frames or cameras, rounded, in ascending order, without zeros."""
    return sorted({amount for share in SHARES if (amount := round(share * whole))})


def measure(store: Store, recording: Artifact) -> dict[str, Cost]:
    """Return the cost of each stage and of one image."""
    settings = load_settings("fast", [f"training.steps={STEPS}"])
    costs: dict[str, Cost] = {}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        reset_peak()
        started = time.perf_counter()
        found = work()
        costs[name] = time.perf_counter() - started, peak_mib() / 1024
        return found

    calibration = timed("calibration", lambda: calibrate(store, recording, settings.calibration))
    segmentation = timed("segmentation", lambda: segment_subject(store, recording, calibration, settings))
    body = timed("fit", lambda: fit(store, recording, calibration, segmentation, settings.fit))
    training = timed("training", lambda: train(store, recording, calibration, segmentation, body, settings.training))
    costs["training"] = costs["training"][0], training.metrics["peak_memory_gib"]  # training runs in a separate process
    avatar, capture = load_avatar(training.root), calibrated_capture(recording, calibration)
    camera = capture.cameras[capture.train_cameras[0]]
    avatar.render(camera, avatar.body.theta[0], avatar.body.root[0])
    timed("one image", lambda: avatar.render(camera, avatar.body.theta[0], avatar.body.root[0]))
    return costs


def draw(costs: dict[str, dict[int, dict[str, Cost]]], path: Path) -> None:
    """Draw a panel for each axis, with both scales logarithmic. Grey lines have the slope of proportional cost."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    for axes, (axis, rows) in zip(
        figure.subplots(1, len(costs), sharey=True, squeeze=False)[0], costs.items(), strict=True
    ):
        amounts = list(rows)
        for marker, stage in zip(MARKERS, next(iter(rows.values())), strict=True):
            spent = [row[stage][0] for row in rows.values()]
            axes.loglog(amounts, spent, marker=marker, color="black", linewidth=1, markersize=5, label=stage)
            axes.loglog(amounts, [spent[0] * n / amounts[0] for n in amounts], color="0.75", linewidth=1, zorder=0)
        axes.set_xlabel("pixels of an image" if axis == "pixels" else f"training {axis}")
        axes.set_xticks(amounts, [f"{n:g}" for n in amounts])
        axes.minorticks_off()
    figure.axes[0].set_ylabel("seconds")
    figure.axes[-1].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
