"""Break the cameras of the shared captures in known ways, and test whether the calibration stage names the fault and
repairs it.

usage: python benchmarks/calibration.py [CAPTURE ...] [--trials 100] [--untouched 20]

A trial takes three quarters of a capture's frames, consecutive from a random start, and breaks one camera or the whole
rig; the capture's own cameras are the truth. "Named": that camera and no other is changed (for a fault of time or
convention, with the right offset or cause), or the capture is refused for the right cause. "After": the median distance
in the image, over the body's exact keypoints, between their projections by the calibrated cameras, at the instants that
these assume, and the true ones; of the worst camera. Untouched trials, every other one with a random half of the
frames, must change nothing. Outlines and matches in the images do not depend on the calibration and are computed once a
capture. Needs `../shared` beside this checkout. Writes `benchmarks/results/calibration-faults.json` and `.md`.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from provenance import SHARED, arguments, provenance, provenance_line, table, write_result

from hnerf.calibration.check import check_calibration
from hnerf.calibration.matches import Matches
from hnerf.calibration.silhouettes import Outlines
from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.config import CalibrationSettings, CaptureSettings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

CAPTURES = ("valid-walk", "valid-wave")
RUN_SHARE = 0.75
INVERTED = "the extrinsics are camera to world (inverted)"
TRANSPOSED = "R is transposed"
MILLIMETRES = "millimetres"


@dataclasses.dataclass(frozen=True)
class Fault:
    """A way to break cameras. share: of all trials; change: applied to a camera with a random generator; rig: whether
    to change all cameras instead of one; frames: offset by which the camera's recording starts too late or too early;
    cause: the reason that must be named."""

    share: float
    change: Callable[[Camera, np.random.Generator], Camera] = lambda camera, rng: camera
    rig: bool = False
    frames: int = 0
    cause: str = ""


def _turned_and_moved(camera: Camera, rng: np.random.Generator) -> Camera:
    axis, move = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    R = cv2.Rodrigues(np.deg2rad(1.0) * axis)[0] @ camera.R
    return dataclasses.replace(camera, R=R, t_m=-R @ (camera.centre_m + 0.02 * move))


def _zoomed(camera: Camera, rng: np.random.Generator) -> Camera:
    zoom = 1 + 0.03 * rng.choice([-1, 1])
    return dataclasses.replace(camera, K=camera.K * np.array([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]]))


def _in_millimetres(camera: Camera, rng: np.random.Generator) -> Camera:
    return dataclasses.replace(camera, t_m=1000 * camera.t_m)


def _transposed(camera: Camera, rng: np.random.Generator) -> Camera:
    return dataclasses.replace(camera, R=camera.R.T)


def _inverted(camera: Camera, rng: np.random.Generator) -> Camera:
    return dataclasses.replace(camera, R=camera.R.T, t_m=camera.centre_m)


FAULTS = {
    "one camera turned by 1 degree and moved by 2 cm": Fault(0.24, _turned_and_moved),
    "one camera's focal length off by 3 %": Fault(0.16, _zoomed),
    "one camera off by 1 frame": Fault(0.16, frames=1),
    "one camera off by 3 frames": Fault(0.16, frames=3),
    "one camera in millimetres": Fault(0.05, _in_millimetres, cause=MILLIMETRES),
    "one camera's R transposed": Fault(0.05, _transposed, cause=TRANSPOSED),
    "one camera's extrinsics inverted": Fault(0.06, _inverted, cause=INVERTED),
    "all in millimetres": Fault(0.04, _in_millimetres, rig=True, cause=MILLIMETRES),
    "all R transposed": Fault(0.04, _transposed, rig=True, cause=TRANSPOSED),
    "all extrinsics inverted": Fault(0.04, _inverted, rig=True, cause=INVERTED),
}
UNTOUCHED = Fault(0.0)


def main() -> None:
    """Run the trials, print and write the table."""
    parser = arguments(__doc__)
    parser.add_argument("captures", nargs="*", default=list(CAPTURES), metavar="CAPTURE")
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--untouched", type=int, default=20)
    options = parser.parse_args()
    result = provenance() | {"captures": {}}
    for name in options.captures:
        started = time.perf_counter()
        result["captures"][name] = {"trials": _trials(name, options.trials, options.untouched)}
        result["captures"][name]["seconds"] = time.perf_counter() - started
    write_result("calibration-faults", result, as_markdown(result))


def _trials(name: str, trials: int, untouched: int) -> list[dict[str, Any]]:
    schedule = [(what, fault) for what, fault in FAULTS.items() for _ in range(round(fault.share * trials))]
    schedule += [("nothing", UNTOUCHED)] * untouched
    done = []
    with tempfile.TemporaryDirectory() as folder:
        whole = ingest(SHARED / "data" / name, CaptureSettings(), Path(folder) / "whole")
        with np.load(SHARED / "data" / name / "ground_truth" / "joints.npz", allow_pickle=False) as stored:
            truth_m = stored["positions"][:, :25].astype(np.float64)
        with evidence_collected_once(whole):
            for seed, (what, fault) in enumerate(schedule):
                trial = Trial(whole, truth_m, fault, seed, Path(folder) / f"{seed}")
                done.append({"fault": what, "seed": seed, **trial.run()})
                print(name, done[-1], flush=True)
    return done


@contextmanager
def evidence_collected_once(whole: Capture) -> Iterator[None]:
    """While this is open, give all captures the outlines and matches of the whole capture."""
    outlines, matches = cache(partial(Outlines.of, whole)), Matches.of(whole)
    with (
        mock.patch.object(Outlines, "of", lambda _, *frames: outlines(*frames)),
        mock.patch.object(Matches, "of", lambda _: matches),
    ):
        yield


class Trial:
    """One trial: a broken capture, as a folder of links to the original images, and its calibration."""

    def __init__(self, whole: Capture, truth_m: np.ndarray, fault: Fault, seed: int, folder: Path) -> None:
        rng = np.random.default_rng(seed)
        self.whole, self.truth_m, self.fault, self.folder = whole, truth_m, fault, folder
        self.name = self._camera(whole, fault, seed)
        # The broken camera's frame f shows the instant f + delay_frames.
        self.delay_frames = fault.frames * int(rng.choice([-1, 1]))
        margin, count = abs(self.delay_frames), int(RUN_SHARE * len(whole.frames))
        first = int(rng.integers(margin, len(whole.frames) - count - margin + 1))
        self.rows = np.arange(first, first + count)
        if fault is UNTOUCHED and seed % 2:
            self.rows = np.sort(rng.choice(len(whole.frames), len(whole.frames) // 2, replace=False))
        self.cameras = {
            name: fault.change(camera, rng) if fault.rig or name == self.name else camera
            for name, camera in whole.cameras.items()
        }

    @staticmethod
    def _camera(whole: Capture, fault: Fault, seed: int) -> str:
        """Return the camera to break, each in turn. A camera that the fault would not change (its R is symmetric) is
        skipped."""
        names, rng = whole.train_cameras, np.random.default_rng(seed)
        broken = {name: fault.change(whole.cameras[name], rng).projection for name in names}
        changed_names = [name for name in names if not np.allclose(broken[name], whole.cameras[name].projection)]
        return (changed_names or names)[seed % len(changed_names or names)]

    def run(self) -> dict[str, Any]:
        """Run the calibration stage; return its findings and the remaining error."""
        capture, started = self._broken(), time.perf_counter()
        try:
            report = check_calibration(capture, CalibrationSettings())
        except InputError as refusal:
            said = str(refusal).removeprefix(f"{capture.name}: ")
            named = bool(self.fault.cause) and self.fault.cause in said and " or " not in said
            return {"camera": self.name, "seconds": time.perf_counter() - started, "named": named, "refused": said}
        seconds = time.perf_counter() - started
        offsets = {name: verdict.frame_offset for name, verdict in report.verdicts.items() if verdict.frame_offset}
        used = capture.with_cameras(report.cameras).synchronised(offsets)
        changed = {name: verdict.reasons for name, verdict in report.verdicts.items() if verdict.status != "ok"}
        offset = used.frame_offsets.get(self.name, 0.0)
        right = set(changed) == ({self.name} if self.fault is not UNTOUCHED else set()) and not self.fault.rig
        cause_named = any(self.fault.cause in reason for reason in changed.get(self.name, [""]))
        return {
            "camera": self.name,
            "seconds": seconds,
            "named": right and cause_named and abs(offset + self.delay_frames) < 0.5,
            "changed": changed,
            "frame_offsets": used.frame_offsets,
            "after_px": self._error_px(used),
        }

    def _broken(self) -> Capture:
        frames = tuple(self.whole.frames[row] for row in self.rows)
        keypoints = {}
        for name in self.whole.train_cameras:
            shown = self.rows + (self.delay_frames if name == self.name else 0)
            found = self.whole.keypoints(name)
            assert found is not None
            keypoints[name] = found[shown]
            (self.folder / "images" / name).mkdir(parents=True)
            for row, frame in zip(shown, frames, strict=True):
                (source,) = (self.whole.root / "images" / name).glob(f"{self.whole.frames[row]:06d}.*")
                (self.folder / "images" / name / f"{frame:06d}{source.suffix}").symlink_to(source)
        np.savez(self.folder / "keypoints.npz", **keypoints)  # type: ignore[arg-type]
        (self.folder / "background").symlink_to(self.whole.root / "background")
        broken = dataclasses.replace(self.whole, root=self.folder, train_frames=frames, novel_pose_frames=())
        return broken.with_cameras(self.cameras)

    def _error_px(self, used: Capture) -> float:
        medians_px = []
        for name in used.train_cameras:
            off = used.frame_offsets.get(name, 0.0) + (self.delay_frames if name == self.name else 0)
            shown_m = self._keypoints_at(np.array(used.frames) + off)
            uv = used.cameras[name].project(shown_m)[0]
            true_uv = self.whole.cameras[name].project(self._keypoints_at(used.frames))[0]
            medians_px.append(float(np.median(np.linalg.norm(uv - true_uv, axis=-1))))
        return max(medians_px)

    def _keypoints_at(self, instants: Any) -> np.ndarray:
        """Interpolate the exact keypoints between frames; return (n, 25, 3) in metres."""
        every = np.arange(len(self.truth_m))
        flat = self.truth_m.reshape(len(every), -1)
        return np.stack([np.interp(instants, every, column) for column in flat.T], -1).reshape(-1, 25, 3)


def as_markdown(result: dict[str, Any]) -> str:
    """Format one table per capture."""
    assert __doc__
    lines = ["# Calibration faults", "", provenance_line(result), "", __doc__.split("\n\n")[2].split(" Needs ")[0]]
    for name, found in result["captures"].items():
        trials = found["trials"]
        broken = [t for t in trials if t["fault"] != "nothing"]
        rows = [["fault", "trials", "named", "after, median px", "95th percentile px", "largest px"]]
        rows += [_row(what, [t for t in trials if t["fault"] == what]) for what in [*FAULTS, "nothing"]]
        rows.append(_row("all faults", broken))
        lines += ["", f"## {name}", "", *table(rows), "", f"{found['seconds'] / len(trials):.1f} s a trial."]
    return "\n".join([*lines, ""])


def _row(what: str, trials: list[dict[str, Any]]) -> list[str]:
    named = f"{100 * np.mean([t['named'] for t in trials]):.0f} %" if trials else ""
    after = [t["after_px"] for t in trials if "after_px" in t]
    figures = [np.median(after), np.percentile(after, 95), max(after)] if after else []
    return [what, str(len(trials)), named, *([f"{f:.2f}" for f in figures] or ["refused", "", ""])]


if __name__ == "__main__":
    main()
