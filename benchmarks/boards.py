"""Calibrate the shared board footage and compare the cameras with those shipped beside it.

usage: python benchmarks/boards.py

Needs `../shared/data/caliscope-charuco` beside this checkout. Writes `benchmarks/results/boards.json` and `.md`.
"""

import dataclasses
import time
from typing import Any

import numpy as np
from provenance import SHARED, arguments, provenance, provenance_line, table, write_result

from hnerf.calibration.boards.calibrate import calibrate_from_boards, rms
from hnerf.calibration.boards.rig import compare_pairs, solve_boards, solve_rig
from hnerf.capture.formats.caliscope import Caliscope
from hnerf.geometry.camera import Camera

FOOTAGE = "caliscope-charuco"
PROTOCOL = (
    "Intrinsics are the shipped ones, not refined. A board counts as found in a picture with at least 6 corners that "
    "lie on one plane to 1 px. It counts as visible where another camera found it and, placed as all cameras have it, "
    "at least 6 corners fall into the picture and the board faces the camera within 75 degrees; occlusion by hands "
    "is ignored. RMS is over the distances of those corners, in undistorted pixels, with a pose a frame and a time "
    "offset a picture (the cameras had no common shutter); then including the corners off the plane. Held out: cameras "
    "from the first half of the frames, held fixed, on the second half. Shipped: the shipped cameras, held fixed, on "
    "all frames."
)
GOALS = {"found_share": 0.8, "turned_deg": 2.0, "moved_cm": 3.0, "rms_px": 0.5}


def main() -> None:
    """Calibrate, compare, print and write."""
    arguments(__doc__).parse_args()
    where, folder = provenance(), SHARED / "data" / FOOTAGE
    started = time.perf_counter()
    calibration = calibrate_from_boards(folder)
    seconds = time.perf_counter() - started
    lenses = Caliscope(folder).lenses()
    fitted = calibration.fit.cameras
    shipped = [Camera(c.name, c.K, lenses[c.name].R, lenses[c.name].t_m, *c.size_px) for c in fitted]
    pairs, report = compare_pairs(shipped, fitted), calibration.report()
    visible = sum(camera["board_visible"] for camera in report["cameras"].values())
    found = sum(camera["of_these_found"] for camera in report["cameras"].values())
    every, seen_px = calibration.fit.projected_px - calibration.corners.corners_px, calibration.fit.seen_px
    whole, first, second = (
        dataclasses.replace(calibration.corners, corners_px=px, frame_step=1, frames=tuple(range(px.shape[1])))
        for px in (seen_px, *np.split(seen_px, [seen_px.shape[1] // 2], axis=1))
    )
    from_first_half = solve_rig(fitted, first).cameras
    figures: dict[str, Any] = {
        "found_share": found / visible,
        "turned_deg": max(pair["turned_deg"] for pair in pairs.values()),
        "moved_cm": max(pair["moved_cm"] for pair in pairs.values()),
        "rms_px": report["rms_px"],
        "rms_with_corners_off_plane_px": rms(np.linalg.norm(every[np.isfinite(every[..., 0])], axis=-1)),
        "rms_held_out_px": rms(solve_boards(from_first_half, second).error_px()),
        "rms_shipped_px": rms(solve_boards(shipped, whole).error_px()),
        "seconds": seconds,
    }
    result = where | {"footage": FOOTAGE, "protocol": PROTOCOL, "goals": GOALS, "figures": figures}
    result |= {"pairs": pairs, "report": report}
    write_result("boards", result, as_markdown(result))


def as_markdown(result: dict[str, Any]) -> str:
    """Format the goals, a table by camera and a table by pair."""
    figures, cameras = result["figures"], result["report"]["cameras"]
    goals = [
        ["", "measured", "goal"],
        ["boards found of those visible", f"{100 * figures['found_share']:.0f} %", "at least 80 %"],
        ["worst pair against shipped", f"{figures['turned_deg']:.2f}°", "at most 2°"],
        ["", f"{figures['moved_cm']:.1f} cm", "at most 3 cm"],
        ["reprojection, RMS", f"{figures['rms_px']:.2f} px", "at most 0.5 px"],
        ["the same, with corners off the plane", f"{figures['rms_with_corners_off_plane_px']:.2f} px", ""],
        ["the same, held out", f"{figures['rms_held_out_px']:.2f} px", ""],
        ["the same, shipped cameras", f"{figures['rms_shipped_px']:.2f} px", ""],
        ["detection and calibration", f"{figures['seconds']:.0f} s", ""],
    ]
    by_camera = [["camera", "found / visible", "corners", "not flat", "RMS px", "offset in frames, 5 / 50 / 95 %"]]
    for name, c in cameras.items():
        offsets = " / ".join(f"{offset:+.2f}" for offset in c["offset_frames_p5_p50_p95"])
        shown = f"{c['of_these_found']} / {c['board_visible']}"
        by_camera.append([name, shown, str(c["corners"]), str(c["corners_not_flat"]), f"{c['rms_px']:.2f}", offsets])
    by_pair = [["pair", "degrees", "cm"]]
    by_pair += [[name, f"{p['turned_deg']:.2f}", f"{p['moved_cm']:.1f}"] for name, p in result["pairs"].items()]
    intrinsics = [f"- {name}: {camera['intrinsics']}" for name, camera in cameras.items()]
    head = [f"# Cameras from board footage: `{result['footage']}`", "", provenance_line(result), ""]
    body = [*table(goals), "", *table(by_camera), "", *table(by_pair), "", "## Intrinsics", "", *intrinsics]
    return "\n".join([*head, *body, "", "## Protocol", "", result["protocol"], ""])


if __name__ == "__main__":
    main()
