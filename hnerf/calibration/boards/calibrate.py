"""Calibration from footage of a board, and what such footage says about given cameras."""

import dataclasses
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hnerf.calibration.boards import rig
from hnerf.calibration.boards.bundle import BoardFit, Poses
from hnerf.calibration.boards.lens import LensEstimate, estimate_lens
from hnerf.calibration.boards.picture import draw_boards
from hnerf.capture.board_footage import BoardCorners, BoardFootage, load_board_corners, read_board_footage
from hnerf.capture.capture import Capture
from hnerf.capture.formats.export import write_calibration
from hnerf.capture.ingest import recognise
from hnerf.capture.lens import Lens, undistort_points
from hnerf.capture.safe_io import path_in_capture
from hnerf.capture.uncalibrated import read_lenses
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

MAX_TILT_DEG = 75.0  # a board tilted further is too slanted to be detected
MAX_OFF = 0.003  # of an image's longer side, by a camera's median corner: ten times what good footage leaves
INTRINSICS = ("intri.yml", "camera_array.toml", "calibration.toml")
WHOLE_CALIBRATIONS = ("sparse", "calibration/Calib*.toml")
FROM_PERSON = "Calib_person.toml"  # files of another format beside it may not say which lenses were estimated

log = logging.getLogger("hnerf.calibration")


@dataclass(frozen=True)
class BoardCalibration:
    """Result of a board calibration. lenses: with distortion, as recorded; intrinsics: their source, in words;
    corners: all that were detected; `fit` holds those used."""

    lenses: dict[str, Lens]
    intrinsics: dict[str, str]
    corners: BoardCorners
    fit: BoardFit

    def report(self) -> dict[str, Any]:
        """Return the content of `report.json`. Residuals in undistorted pixels, offsets in frames of the footage."""
        visible, found = visible_and_found(self.fit, self.corners.corners_m)
        cameras = {
            camera.name: _figures(self.fit, i)
            | {
                "corners_not_flat": int(np.isfinite(self.corners.corners_px[i, ..., 0]).sum())
                - len(self.fit.error_px(i)),
                "board_visible": int(visible[i].sum()),
                "of_these_found": int((visible[i] & found[i]).sum()),
                "intrinsics": self.intrinsics[camera.name],
            }
            for i, camera in enumerate(self.fit.cameras)
        }
        return {"frames": found.shape[1], "rms_px": rms(self.fit.error_px()), "cameras": cameras}

    def save(self, out: Path, layouts: Sequence[str] = (), pose2sim: bool = False) -> None:
        """Write `report.json` and `boards.png`, and the cameras as `write_calibration` does."""
        write_calibration(out, list(self.lenses.values()), "boards", layouts, pose2sim)
        (out / "report.json").write_text(json.dumps(self.report(), indent=1))
        draw_boards(out / "boards.png", self.fit)


def calibrate_from_boards(folder: Path, ground_frame: int | None = None) -> BoardCalibration:
    """Calibrate the cameras from the board footage in a folder's `calibration/`.

    Intrinsics come from calibration/intrinsic/ if it determines them, else from the folder's calibration files, or, for
    a camera with neither, from calibration/extrinsic/. The world is the first camera, or the board as it lies in frame
    `ground_frame` (Z up, origin at its top left corner). Raises InputError if the footage lacks what is needed.
    """
    footage = read_board_footage(folder, "extrinsic", ground_frame)
    if footage is None:
        raise InputError(
            f"{folder / 'calibration' / 'extrinsic'}: no board footage, or no charuco.toml and no [board] in "
            "capture.toml to describe the board; add them, or calibrate with --from person"
        )
    _check_board_found(footage)
    lenses, intrinsics = _intrinsics(folder, footage)
    corners_px = np.stack([undistort_points(footage.corners_px[name], lens) for name, lens in lenses.items()])
    cameras = [Camera(n, lens.K, np.eye(3), np.zeros(3), *footage.sizes_px[n]) for n, lens in lenses.items()]
    log.info("adjusting %d cameras to %d corners", len(cameras), int(np.isfinite(corners_px[..., 0]).sum()))
    corners = BoardCorners(tuple(lenses), footage.board.corners_m, corners_px, footage.frame_step, footage.frames)
    fit = rig.solve_rig(cameras, rig.planar_corners(corners))
    _check_agreement(footage, fit)
    if ground_frame is not None:
        fit = _on_ground(fit, footage, ground_frame)
    lenses = {c.name: dataclasses.replace(lenses[c.name], R=c.R, t_m=c.t_m) for c in fit.cameras}
    return BoardCalibration(lenses, intrinsics, corners, fit)


def board_evidence(capture: Capture) -> dict[str, Any] | None:
    """Return what board footage says about a capture's cameras; None if the recording has none.

    "cameras": per camera, the corners' distances (px) from the board that all cameras agree on, with the cameras as
    given and, as `footage_rms_px`, with cameras estimated from the footage itself. "pairs": `compare_pairs` of the two.
    "unlinked_cameras": those that never see the board together with the others, about which nothing is known.
    """
    stored = load_board_corners(capture.root)
    if stored is None:
        return None
    corners = rig.planar_corners(stored.select([name for name in stored.cameras if name in capture.cameras]))
    names = rig.largest_linked_group(corners)
    if len(names) < 2:
        return {"frames": len(corners.frames), "cameras": {}, "pairs": {}, "unlinked_cameras": [*corners.cameras]}
    cameras = [capture.cameras[name] for name in names]
    own, given = (solve(cameras, corners.select(names)) for solve in (rig.solve_rig, rig.solve_boards))
    figures = {
        camera.name: _figures(given, i) | {"footage_rms_px": rms(own.error_px(i))} for i, camera in enumerate(cameras)
    }
    return {
        "frames": len(corners.frames),
        "cameras": figures,
        "pairs": rig.compare_pairs(cameras, own.cameras),
        "unlinked_cameras": [name for name in corners.cameras if name not in names],
    }


def visible_and_found(fit: BoardFit, corners_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two masks (C, F) bool: where a camera should see the board, and where the board was found with enough
    corners to determine its pose.

    Visible: another camera found the board and, at its fitted pose, at least MIN_CORNERS corners fall into this
    camera's image and the board faces it within MAX_TILT_DEG. Occlusion is not known, so occluded boards count as
    visible.
    """
    found = np.isfinite(fit.residuals_px[..., 0]).sum(-1) >= rig.MIN_CORNERS
    corners = np.einsum("fij,nj->fni", fit.boards.R, corners_m) + fit.boards.t_m[:, None]
    visible = np.zeros_like(found)
    for i, camera in enumerate(fit.cameras):
        uv, depth_m = camera.project(corners)
        inside = camera.holds(uv) & (depth_m > 0)
        towards = corners.mean(1) - camera.centre_m
        cosine = (fit.boards.R[..., 2] * towards).sum(-1) / np.linalg.norm(towards, axis=-1)
        by_others = np.delete(found, i, axis=0).any(0)
        visible[i] = by_others & (inside.sum(-1) >= rig.MIN_CORNERS) & (cosine > np.cos(np.deg2rad(MAX_TILT_DEG)))
    return visible, found


def _check_board_found(footage: BoardFootage) -> None:
    """Raise InputError if no camera sees enough of the board to be linked: the footage probably shows a board other
    than the described one."""
    corners_px = np.stack(list(footage.corners_px.values()))
    found = rig.fixes_pose(footage.board.corners_m, np.isfinite(corners_px[..., 0]))
    if found.sum(1).max() < rig.MIN_SHARED:
        raise InputError(
            f"{footage.path}: this board was found in {found.sum()} of {found.size} pictures; check its columns, rows, "
            "dictionary and inverted in charuco.toml or capture.toml"
        )


def _check_agreement(footage: BoardFootage, fit: BoardFit) -> None:
    """Raise InputError if the cameras do not see one board: no poses then explain a camera's corners."""
    off_px = [float(np.median(fit.error_px(i))) for i in range(len(fit.cameras))]
    worst = int(np.argmax([px / max(camera.size_px) for px, camera in zip(off_px, fit.cameras, strict=True)]))
    if off_px[worst] > MAX_OFF * max(fit.cameras[worst].size_px):
        raise InputError(
            f"{footage.path}: camera {fit.cameras[worst].name}: its corners are {off_px[worst]:.1f} px from the board "
            "that all cameras see; cut the footage so that all cameras start within a frame, or correct the intrinsics"
        )


def _intrinsics(folder: Path, footage: BoardFootage) -> tuple[dict[str, Lens], dict[str, str]]:
    """Return the lens of every camera in the extrinsic footage, and where it comes from, in words."""
    close = read_board_footage(folder, "intrinsic")
    given = _given_lenses(folder)
    lenses, words = {}, {}
    for name, size_px in footage.sizes_px.items():
        source = close if close is not None and name in close.corners_px else footage
        found = estimate_lens(name, source.board.corners_m, source.corners_px[name], source.sizes_px[name])
        if found.reliable_lens and (source is close or name not in given):
            lenses[name], words[name] = found.reliable_lens, f"from {source.path.name}/: {found.certainty}"
            if not found.describes_corners:
                log.warning(
                    "%s: corners are off by %.1f px (RMS), too much for its lens to be right, also as a fisheye; film "
                    "a flat, sharp board, or undistort its video",
                    source.path / name,
                    found.rms_px,
                )
        elif name in given:
            lenses[name], words[name] = given[name], f"given; {_compared(found, given[name])}"
        else:
            raise InputError(
                f"{source.path / name}: does not fix the intrinsics ({found.certainty}); film the board closer, "
                "tilted and in all corners of the picture, or give intrinsics"
            )
        known_px = lenses[name].size_px or size_px
        if known_px != size_px:
            raise InputError(
                f"{footage.path / name}: is {size_px[0]} x {size_px[1]} px, but its intrinsics are for {known_px[0]} x "
                f"{known_px[1]}; use one size"
            )
        lenses[name] = dataclasses.replace(lenses[name], size_px=size_px)
    return lenses, words


def _given_lenses(folder: Path) -> dict[str, Lens]:
    """Return the lenses of the calibration file in a folder, which need not contain poses; none if there is no such
    file. Those that were estimated from the person are left out: intri.yml marks them, files beside FROM_PERSON may
    hold them unmarked."""
    from_person = (folder / "calibration" / FROM_PERSON).exists()
    paths = (path_in_capture(folder, name) for name in (INTRINSICS[:1] if from_person else INTRINSICS))
    whole = not from_person and any(any(folder.glob(name)) for name in WHOLE_CALIBRATIONS)
    if file := next((path for path in paths if path.exists()), None):
        lenses = read_lenses(file)
    else:
        lenses = recognise(folder).lenses() if whole else {}
    return {name: lens for name, lens in lenses.items() if not lens.estimated}


def _compared(found: LensEstimate, given: Lens) -> str:
    if found.reliable_lens is None:
        return f"not verified by the footage ({found.certainty})"
    differs = 100 * (found.reliable_lens.K[0, 0] / given.K[0, 0] - 1)
    return f"the footage's own focal length differs by {differs:+.1f} % ({found.certainty})"


def _on_ground(fit: BoardFit, footage: BoardFootage, ground_frame: int) -> BoardFit:
    """Return the rig in the world whose origin and floor are the board in one frame. The board's z points down, so it
    is turned about x."""
    index = footage.frames.index(ground_frame) if ground_frame in footage.frames else -1
    if index < 0 or not np.isfinite(fit.residuals_px[:, index]).any():
        raise InputError(f"{footage.path}: no board in frame {ground_frame}; name a frame in which it lies flat")
    to_ground = np.diag([1.0, -1.0, -1.0]) @ fit.boards.R[index].T
    origin_m = fit.boards.t_m[index]
    cameras = [dataclasses.replace(c, R=c.R @ to_ground.T, t_m=c.R @ origin_m + c.t_m) for c in fit.cameras]
    boards = Poses(to_ground @ fit.boards.R, (fit.boards.t_m - origin_m) @ to_ground.T)
    return dataclasses.replace(fit, cameras=cameras, boards=boards)


def _figures(fit: BoardFit, camera: int) -> dict[str, Any]:
    """Return the statistics of one camera's corners."""
    error_px, offsets = fit.error_px(camera), fit.offsets_frames[camera]
    offsets = offsets[np.isfinite(offsets)]
    at = np.quantile(offsets, [0.05, 0.5, 0.95]).tolist() if len(offsets) else None
    return {
        "pictures": len(offsets),
        "corners": len(error_px),
        "rms_px": rms(error_px),
        "median_px": float(np.median(error_px)) if len(error_px) else None,
        "offset_frames_p5_p50_p95": at,
    }


def rms(error_px: np.ndarray) -> float | None:
    """Return the root mean square; None if there are no errors."""
    return float(np.sqrt((error_px**2).mean())) if len(error_px) else None
