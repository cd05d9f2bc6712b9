"""Fisheyes from footage of a board: corners that a known lens images."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.calibration.boards import calibrate as calibration_boards
from hnerf.calibration.boards.fisheye import _projected, fit_fisheye
from hnerf.calibration.boards.lens import estimate_lens
from hnerf.capture.board_footage import BoardFootage
from hnerf.capture.formats.export import write_cameras
from hnerf.capture.ingest import recognise
from hnerf.capture.lens import Lens, undistort_points
from tests.calibration.boards.test_calibrate import BOARD, FRAMES, NOISE_PX, board_at, rig

SIZE_PX = (1280, 720)
POSITIONS = [(x, y) for x in (160, 400, 640, 880, 1120) for y in (120, 290, 430, 600)]  # pixels of the board's middle
MIDDLE_M = BOARD.corners_m.mean(0)


def lens_of(across_deg: float, k: tuple[float, ...]) -> Lens:
    """Return a fisheye whose ray at half this angle is at the left and right border."""
    half = np.deg2rad(across_deg / 2)
    focal_px = 640 / (half * (1 + sum(term * half ** (2 * i) for i, term in enumerate(k, start=1))))
    K = np.array([[focal_px, 0, 645], [0, focal_px, 352], [0, 0, 1]])
    return Lens("a", K, np.array(k), np.eye(3), np.zeros(3), SIZE_PX, fisheye=True)


def imaged(lens: Lens, corners_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return where a camera sees corners (N, 3) of its own frame, with noise; NaN outside the image."""
    at_px = cv2.fisheye.projectPoints(corners_m[:, None].copy(), np.zeros(3), np.zeros(3), lens.K, lens.distortion)[0]
    at_px = at_px[:, 0] + NOISE_PX * rng.normal(size=(len(corners_m), 2))
    inside = np.all((at_px > 0) & (at_px < SIZE_PX), axis=1) & (corners_m[:, 2] > 0)
    return np.where(inside[:, None], at_px, np.nan)


def close_up(lens: Lens, seed: int) -> np.ndarray:
    """Return corners (20, N, 2) of a board, 0.3 m away and tilted by up to 0.7 radians about each axis, all over the
    image."""
    rng, views = np.random.default_rng(seed), []
    for ray in np.c_[undistort_points(np.array(POSITIONS, float), lens), np.ones(20)] @ np.linalg.inv(lens.K).T:
        z = ray / np.linalg.norm(ray)
        x = np.cross([0, 1, 0], z) / np.hypot(z[0], z[2])
        R = np.stack([x, np.cross(z, x), z], 1) @ cv2.Rodrigues(rng.uniform(-0.7, 0.7, 3))[0]
        views.append(imaged(lens, (BOARD.corners_m - MIDDLE_M) @ R.T + 0.3 * z, rng))
    return np.array(views)


@pytest.mark.parametrize("across_deg", [105, 125, 150, 170])
def test_a_fisheye_is_found_where_it_describes_the_corners_clearly_better(across_deg: float) -> None:
    """Other lenses describe the corners of the first too, but with rays several pixels off."""
    lens = lens_of(across_deg, (0.02, -0.01, 0.004, -0.001))
    found = estimate_lens("a", BOARD.corners_m, close_up(lens, 1), SIZE_PX)
    assert found.reliable_lens is not None and found.reliable_lens.fisheye and found.describes_corners
    assert "of them tilted, a fisheye, focal length known to 0." in found.certainty
    grid = np.stack(np.meshgrid(np.linspace(100, 1180, 9), np.linspace(60, 660, 9)), -1)
    rays, truth = (undistort_points(grid, one) for one in (found.reliable_lens, lens))
    back = [(at_px - one.K[:2, 2]) / one.K[0, 0] for at_px, one in ((rays, found.reliable_lens), (truth, lens))]
    assert np.nanmax(np.abs(np.arctan(back[0]) - np.arctan(back[1]))) < np.deg2rad(0.15)


def test_the_standard_deviation_is_how_far_focal_lengths_scatter() -> None:
    """Of 16 recordings with other noise: a spread known to 1 / sqrt(2 x 15) = 18 %, here within three times that."""
    lens = lens_of(150, (0.02, -0.01, 0.004, -0.001))
    off = []
    for seed in range(16):
        views = close_up(lens, seed)
        seen = [np.isfinite(view[:, 0]) for view in views]
        shown = [BOARD.corners_m[s] for s in seen], [view[s] for view, s in zip(views, seen, strict=True)]
        fit = fit_fisheye("a", *shown, SIZE_PX)
        off.append((fit.lens.K[0, 0] / lens.K[0, 0] - 1) / fit.focal_std)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1, abs=0.55)


def test_derivatives_are_those_by_differences() -> None:
    unknowns = np.array([400, 410, 640, 360, 0.01, 0.02, 0.01, 0.005, *[0.1, 0.2, 0.3, -0.05, 0.02, 0.3] * 2])
    unknowns[14:] += 0.05
    boards, steps = [BOARD.corners_m, BOARD.corners_m[:7]], 1e-6 * np.eye(20)
    by_steps = [_projected(unknowns + h, boards)[0] - _projected(unknowns - h, boards)[0] for h in steps]
    np.testing.assert_allclose(_projected(unknowns, boards)[1], np.stack(by_steps, 1) / 2e-6, atol=1e-5)


@pytest.mark.parametrize("given", [False, True])
def test_a_rig_of_fisheyes_is_calibrated_and_written(
    given: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Lenses come from footage close to the board, or from a file."""
    lens, rng, cameras = lens_of(150, (0.02, -0.01, 0.004, -0.001)), np.random.default_rng(3), rig()
    moments = [board_at(frame) for frame in range(FRAMES)]
    boards_m = [BOARD.corners_m @ R.T + t_m for R, t_m in moments]
    far = {c.name: np.stack([imaged(lens, board @ c.R.T + c.t_m, rng) for board in boards_m]) for c in cameras}
    near = {camera.name: close_up(lens, seed) for seed, camera in enumerate(cameras)}
    read = {
        part: BoardFootage(tmp_path / part, BOARD, tuple(range(len(seen["a"]))), 1, seen, dict.fromkeys("abc", SIZE_PX))
        for part, seen in {"extrinsic": far, "intrinsic": near}.items()
    }
    if given:
        del read["intrinsic"]
        write_cameras(tmp_path, [dataclasses.replace(lens, name=name) for name in "abc"], "aniposelib")
    monkeypatch.setattr(calibration_boards, "read_board_footage", lambda _, part, *__: read.get(part))
    found = calibration_boards.calibrate_from_boards(tmp_path)
    assert found.intrinsics["a"].startswith("given" if given else "from intrinsic/: 20 pictures of the board")
    pairs = calibration_boards.rig.compare_pairs(cameras, found.fit.cameras)
    assert all(pair["turned_deg"] < 0.3 and pair["moved_cm"] < 0.8 for pair in pairs.values())
    found.save(tmp_path / "cameras")
    assert sorted(path.name for path in (tmp_path / "cameras").iterdir()) == [
        "boards.png",
        "calibration.toml",
        "report.json",
    ]
    assert all(one.fisheye for one in recognise(tmp_path / "cameras").lenses().values())
    assert "corners are off" not in caplog.text
