"""Measure how the cost of every stage grows with frames, cameras and pixels.

usage: python benchmarks/scaling.py [CAPTURE]

Runs the stages of preset `fast`, training limited to a number of steps, on parts of a shared capture (default
valid-wave) and on images of other sizes, each varied in turn, in a new store. Writes `benchmarks/results/scaling.json`,
`.md` and `.png`; the straight lines of the chart mark proportional cost.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from provenance import RESULTS, SHARED, provenance, provenance_line, table, write_result

from flows.train_subject import segment_subject
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
from tasks.training import load_trained_avatar, train

STEPS = 60
AXES = {"frames": (6, 12, 24), "cameras": (1, 2, 4), "pixels": (0.25, 1.0, 4.0)}  # pixels: relative to the recording
MARKERS = "os^Dv"


def main() -> None:
    """Time all parts, print, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", nargs="?", default="valid-wave")
    options = parser.parse_args()
    where = provenance()
    source, _ = read_capture(SHARED / "data" / options.capture)
    with tempfile.TemporaryDirectory(prefix="hnerf-scaling-") as name:
        folder = Path(name)
        store = Store(folder / "captures")
        recording = ingest(store, source, load_settings("fast").capture)
        seconds = {
            axis: {str(n): measure(Store(folder / f"{axis}-{n}"), part(store, recording, axis, n)) for n in amounts}
            for axis, amounts in AXES.items()
        }
    result = where | {"capture": options.capture, "steps": STEPS, "seconds": seconds}
    lines = [f"# Cost against frames, cameras and pixels: {options.capture}", "", provenance_line(result), ""]
    lines += [f"Seconds of a stage; training is {STEPS} steps, with setup and saving.", ""]
    for axis, rows in seconds.items():
        stages = list(next(iter(rows.values())))
        lines += table([[axis, *stages], *([n, *(f"{row[s]:.1f}" for s in stages)] for n, row in rows.items())])
        lines.append("")
    write_result("scaling", result, "\n".join([*lines, "![seconds against size](scaling.png)", ""]))
    draw(seconds, RESULTS / "scaling.png")
    print("\n".join(lines))


def part(store: Store, recording: Artifact, axis: str, amount: float) -> Artifact:
    """Return the recording with so many training frames or cameras, or so many times the pixels."""
    capture = Capture.load(recording.root)
    if axis == "frames":
        return subset_capture(store, recording, None, tuple(evenly_spaced(capture.train_frames, int(amount))), ())
    if axis == "cameras":
        return subset_capture(store, recording, capture.train_cameras[: int(amount)], None, ())
    if amount == 1:
        return subset_capture(store, recording, None, None, ())
    kind = "small_images" if amount < 1 else "large_images"
    resized = degrade_capture(store, recording, Degradation(kind=kind, strength=amount**0.5, seed=0))
    return subset_capture(store, resized, None, None, ())


def measure(store: Store, recording: Artifact) -> dict[str, float]:
    """Return the seconds of each stage and of one image."""
    settings = load_settings("fast", [f"training.steps={STEPS}"])
    seconds: dict[str, float] = {}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        started = time.perf_counter()
        found = work()
        seconds[name] = time.perf_counter() - started
        return found

    calibration = timed("calibration", lambda: calibrate(store, recording, settings.calibration))
    segmentation = timed("segmentation", lambda: segment_subject(store, recording, calibration, settings))
    body = timed("fit", lambda: fit(store, recording, calibration, segmentation, settings.fit))
    training = timed("training", lambda: train(store, recording, calibration, segmentation, body, settings.training))
    avatar, capture = load_trained_avatar(training), calibrated_capture(recording, calibration)
    camera = capture.cameras[capture.train_cameras[0]]
    avatar.render(camera, avatar.body.theta[0], avatar.body.root[0])
    timed("one image", lambda: avatar.render(camera, avatar.body.theta[0], avatar.body.root[0]))
    return seconds


def draw(seconds: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Draw a panel for each axis, both scales logarithmic; grey lines have the slope of proportional cost."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    for axes, (axis, rows) in zip(
        figure.subplots(1, len(seconds), sharey=True, squeeze=False)[0], seconds.items(), strict=True
    ):
        amounts = [float(n) for n in rows]
        for marker, stage in zip(MARKERS, next(iter(rows.values())), strict=True):
            spent = [row[stage] for row in rows.values()]
            axes.loglog(amounts, spent, marker=marker, color="black", linewidth=1, markersize=5, label=stage)
            axes.loglog(amounts, [spent[0] * n / amounts[0] for n in amounts], color="0.75", linewidth=1, zorder=0)
        axes.set_xlabel("pixels, as a multiple of the recorded" if axis == "pixels" else f"training {axis}")
        axes.set_xticks(amounts, [f"{n:g}" for n in amounts])
        axes.minorticks_off()
    figure.axes[0].set_ylabel("seconds")
    figure.axes[-1].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
