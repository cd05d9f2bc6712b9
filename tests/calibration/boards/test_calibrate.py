"""Board calibration: known cameras around a board on a known path, and real footage."""

import dataclasses
import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flows.commands import _advice, _is_pose2sim
from hnerf.calibration.boards import calibrate as calibration_boards
from hnerf.calibration.boards.bundle import Adjustment, BoardFit, Poses
from hnerf.calibration.boards.calibrate import board_evidence, calibrate_from_boards, visible_and_found
from hnerf.calibration.boards.lens import _moved, estimate_lens
from hnerf.calibration.boards.rig import compare_pairs, fixes_pose, planar_corners, solve_boards, solve_rig
from hnerf.capture.board_footage import Board, BoardCorners, BoardFootage
from hnerf.capture.formats.caliscope import Caliscope
from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.formats.export import write_calibration, write_cameras
from hnerf.capture.formats.pose2sim import Pose2Sim
from hnerf.capture.ingest import recognise
from hnerf.capture.lens import Lens
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import look_at, turned, write_capture
from tests.shared_data import shared_capture

BOARD = Board(columns=6, rows=5, square_m=0.05)
FRAMES = 16
LAG = 0.4  # frames, of camera b
NOISE_PX = 0.1


def rig() -> list[Camera]:
    """Return three cameras 1.5 m from the board's path, 30 degrees apart, none of them at the world's origin."""
    target = np.array([0, 0, 1.0])
    centres = [[1.5 * np.sin(a), -1.5 * np.cos(a), 1.2] for a in np.deg2rad([-30, 0, 30])]
    return [look_at(name, np.array(c), target) for name, c in zip("abc", centres, strict=True)]


def board_at(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the world-from-board pose at a time in frames: the board faces the cameras, swings, and moves along a
    circle."""
    facing = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, y down, z away from the cameras
    swing = cv2.Rodrigues(np.array([0.5 * np.sin(0.3 * time), 0.4 * np.cos(0.2 * time), 0.1 * time]))[0]
    t_m = np.array([0.25 * np.cos(0.25 * time), 0.2 * np.sin(0.4 * time), 1 + 0.25 * np.sin(0.25 * time)])
    return facing @ swing, t_m


def seen(cameras: list[Camera], lags: dict[str, float], frames: Sequence[int] = range(FRAMES)) -> np.ndarray:
    """Return corners (C, F, N, 2) with noise. lags: by how many frames a camera takes each image later."""
    corners_px = np.zeros((len(cameras), len(frames), len(BOARD.corners_m), 2))
    for i, camera in enumerate(cameras):
        for row, frame in enumerate(frames):
            R, t_m = board_at(frame + lags.get(camera.name, 0.0))
            corners_px[i, row] = camera.project(BOARD.corners_m @ R.T + t_m)[0]
    return corners_px + NOISE_PX * np.random.default_rng(0).normal(size=corners_px.shape)


def corners_of(corners_px: np.ndarray, frames: Sequence[int] = range(FRAMES), frame_step: int = 1) -> BoardCorners:
    """Return the corners (C, F, N, 2) that the first C cameras saw."""
    return BoardCorners(tuple("abc"[: len(corners_px)]), BOARD.corners_m, corners_px, frame_step, tuple(frames))


def test_each_residual_depends_only_on_the_unknowns_that_the_solver_is_told() -> None:
    """The full Jacobian, by differences, is zero outside the pattern. Frame 2 is missing, and c does not see frame
    0."""
    cameras, frames = rig(), (0, 1, 3, 4)
    corners_px = seen(cameras, {"b": LAG}, frames)
    corners_px[2, 0] = np.nan
    R, t_m = zip(*(board_at(frame) for frame in frames), strict=True)
    boards = Poses(np.array(R), np.array(t_m))
    adjustment = Adjustment(cameras, corners_of(corners_px, frames), boards, [False, True, True])
    x = 0.01 * np.random.default_rng(0).normal(size=adjustment.size)
    steps = 1e-4 * np.eye(adjustment.size)
    jacobian = np.stack([adjustment.residuals(x + h) - adjustment.residuals(x - h) for h in steps], -1)
    pattern = adjustment.sparsity().toarray()
    assert pattern.shape == jacobian.shape and pattern.mean() < 0.5
    assert not jacobian[~pattern].any() and jacobian[:, 6:].any(0).all()


def test_pairs_are_compared_in_degrees_and_centimetres() -> None:
    cameras = rig()
    moved = turned(cameras[1], 1.0)
    moved = dataclasses.replace(moved, t_m=moved.t_m + np.array([0.02, 0, 0]))
    pairs = compare_pairs(cameras, [cameras[0], moved, cameras[2]])
    assert pairs["a-b"] == pytest.approx({"turned_deg": 1.0, "moved_cm": 2.0})
    assert pairs["a-c"] == pytest.approx({"turned_deg": 0.0, "moved_cm": 0.0}, abs=1e-6)
    # c seen from b: b turned by a degree, so c's centre, 1.5 x 2 sin 15 degrees away, swings by that times a degree.
    assert pairs["b-c"]["turned_deg"] == pytest.approx(1.0)
    assert abs(pairs["b-c"]["moved_cm"] - 100 * 3 * np.sin(np.pi / 12) * np.deg2rad(1)) < 2.0


def test_cameras_and_their_lag_are_found() -> None:
    cameras = rig()
    corners_px = seen(cameras, {"b": LAG})
    corners_px[2, :4] = np.nan
    corners_px[0, 5, 3] += 30.0  # one corner mistaken for another
    fit = solve_rig(cameras, planar_corners(corners_of(corners_px)))
    for figures in compare_pairs(cameras, fit.cameras).values():
        assert figures["turned_deg"] < 0.3 and figures["moved_cm"] < 0.8  # 4 degrees and 8 cm if b's lag is ignored
    # Only differences between cameras can be known: a and c were synchronised, b was later.
    lag = np.nanmedian(fit.offsets_frames[1] - fit.offsets_frames[0])
    assert lag == pytest.approx(LAG, abs=0.05)
    assert np.isnan(fit.residuals_px[0, 5, 3]).all() and np.isfinite(fit.residuals_px[0, 5, 4]).all()
    # Noise of 0.1 px in x and y is 0.14 px of distance.
    assert np.sqrt((fit.error_px() ** 2).mean()) == pytest.approx(NOISE_PX * np.sqrt(2), abs=0.03)


def test_offsets_are_in_frames_of_the_footage() -> None:
    """If only every second frame is used, a lag of 0.4 of the interval between images is 0.8 frames."""
    cameras = rig()
    fit = solve_rig(cameras, planar_corners(corners_of(seen(cameras, {"b": LAG}), frame_step=2)))
    lag = np.nanmedian(fit.offsets_frames[1] - fit.offsets_frames[0])
    assert lag == pytest.approx(2 * LAG, abs=0.1)
    assert max(figures["turned_deg"] for figures in compare_pairs(cameras, fit.cameras).values()) < 0.3


def test_frames_across_a_gap_are_not_neighbours() -> None:
    cameras, frames = rig(), [first + i for first in (0, 20, 40, 60) for i in range(4)]
    fit = solve_rig(cameras, planar_corners(corners_of(seen(cameras, {"b": LAG}, frames), frames)))
    for figures in compare_pairs(cameras, fit.cameras).values():
        assert figures["turned_deg"] < 1 and figures["moved_cm"] < 2
    assert np.nanmedian(fit.offsets_frames[1] - fit.offsets_frames[0]) == pytest.approx(LAG, abs=0.1)


def test_off_plane_corners_and_images_with_few_corners_are_dropped() -> None:
    corners_px = seen(rig(), {})[:1, :2]
    corners_px[0, 0, 7] += [3.0, 0]
    corners_px[0, 1, 5:] = np.nan  # five are left
    kept = np.isfinite(planar_corners(corners_of(corners_px, range(2))).corners_px[..., 0])
    assert np.flatnonzero(~kept[0, 0]).tolist() == [7] and not kept[0, 1].any()


def test_a_pose_needs_six_corners_in_two_rows() -> None:
    seen = np.zeros((4, 20), bool)  # five columns, four rows
    seen[0, :6] = seen[1, :7] = seen[2, :5] = seen[3, [0, 1, 5, 6, 10]] = True
    assert fixes_pose(BOARD.corners_m, seen).tolist() == [False, True, False, False]


def test_unlinked_cameras_are_refused() -> None:
    corners_px = seen(rig(), {})
    corners_px[2, 2:] = np.nan  # c shares only two frames
    with pytest.raises(InputError, match="camera c: shares fewer than 3 frames"):
        solve_rig(rig(), corners_of(corners_px))


def evidence(
    root: Path, cameras: list[Camera], corners_px: np.ndarray, frames: Sequence[int] = range(FRAMES)
) -> dict[str, Any]:
    """Return the evidence of footage whose corners (C, F, N, 2) were found by the first C cameras of a capture."""
    capture = write_capture(root, cameras, np.zeros((3, 2, 25, 3)))
    assert board_evidence(capture) is None
    corners_of(corners_px, frames).save(capture.root)
    found = board_evidence(capture)
    assert found is not None
    return found


def test_board_evidence_lists_unlinked_cameras(tmp_path: Path) -> None:
    corners_px = seen(rig(), {})
    corners_px[2] = np.nan
    three, one = evidence(tmp_path / "3", rig(), corners_px), evidence(tmp_path / "1", rig(), corners_px[:1])
    assert three["unlinked_cameras"] == ["c"] and list(three["cameras"]) == ["a", "b"]
    assert one["unlinked_cameras"] == ["a"] and one["cameras"] == {}


def test_board_evidence_names_the_camera_that_moved(tmp_path: Path) -> None:
    cameras = rig()
    bumped = [cameras[0], turned(cameras[1], 1.0), cameras[2]]
    found = evidence(tmp_path, bumped, seen(cameras, {}))
    rms_px = {name: camera["rms_px"] for name, camera in found["cameras"].items()}
    # One degree at a focal length of 1000 px is 17.5 px; the other two agree and determine the board's pose.
    assert 10 < rms_px["b"] < 20 and max(rms_px["a"], rms_px["c"]) < 5
    assert max(camera["footage_rms_px"] for camera in found["cameras"].values()) < 0.2
    assert found["pairs"]["a-b"]["turned_deg"] == pytest.approx(1.0, abs=0.1)
    assert found["pairs"]["a-c"]["turned_deg"] < 0.1


def test_a_visible_board_faces_the_camera_is_inside_the_image_and_found_by_another_camera() -> None:
    """The board shows its back in frame 1, only c finds it in frame 2, and it is far above every image in frame 3."""
    cameras = rig()
    R, t_m = board_at(0)
    boards = Poses(np.stack([R, R @ np.diag([-1.0, 1, -1]), R, R]), np.stack([t_m, t_m, t_m, t_m + np.eye(3)[2] * 5]))
    corners_px = np.stack([[c.project(BOARD.corners_m @ R.T + t)[0] for R, t in zip(boards.R, boards.t_m, strict=True)]
                           for c in cameras])  # fmt: skip
    corners_px[:2, 2] = np.nan
    fit = solve_boards(cameras, corners_of(corners_px, range(4)))
    visible, found = visible_and_found(dataclasses.replace(fit, boards=boards), BOARD.corners_m)
    assert visible[:, 0].all() and not visible[:, 1].any() and not visible[:, 3].any()
    assert visible[:, 2].tolist() == [True, True, False] and found[:, 2].tolist() == [False, False, True]


def close_up(tilt: float, k3: float = 0.0) -> np.ndarray:
    """Return corners (20, N, 2) seen through a lens of 900 px and k1 = -0.2. tilt: up to how many radians the board is
    turned about each axis."""
    K, distortion = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0, k3])
    rng = np.random.default_rng(1)
    poses = [(rng.uniform(-tilt, tilt, 3), rng.uniform([-0.3, -0.2, 0.6], [0.1, 0.05, 0.6])) for _ in range(20)]
    views = [cv2.projectPoints(BOARD.corners_m, r, t, K, distortion)[0].reshape(-1, 2) for r, t in poses]
    return np.stack(views) + NOISE_PX * rng.normal(size=(20, 20, 2))


def test_a_lens_is_reliable_only_if_the_images_determine_it() -> None:
    """Boards that all face the camera say nothing about the focal length, and nine images are too few."""
    tilted, facing, few = (
        estimate_lens("a", BOARD.corners_m, corners_px, (1280, 720))
        for corners_px in (close_up(0.7), close_up(0.0), close_up(0.7)[:9])
    )
    assert tilted.reliable_lens is not None and tilted.reliable_lens.K[0, 0] == pytest.approx(900, rel=0.005)
    assert tilted.reliable_lens.distortion[0] == pytest.approx(-0.2, abs=0.02)
    assert len(tilted.reliable_lens.distortion) == 4  # noise does not prove k3
    assert facing.reliable_lens is None and few.reliable_lens is None and few.pictures == 9


def test_pictures_of_a_board_held_still_count_as_one() -> None:
    """Forty of them repeat the same errors, and would make a wrong lens look certain."""
    rng = np.random.default_rng(0)
    held, often = (np.repeat(pictures, 40, axis=0) for pictures in (close_up(0.7)[:1], close_up(0.7)))
    still, moved = (
        estimate_lens("a", BOARD.corners_m, corners_px + 3 * rng.uniform(-1, 1, (len(corners_px), 1, 2)), (1280, 720))
        for corners_px in (held, often)
    )
    assert still.pictures == 1 and still.reliable_lens is None and moved.pictures == 20
    assert still.certainty == "pictures between which the board moved: 1 where 10 are needed"


def test_a_board_has_moved_if_most_of_the_corners_that_two_pictures_share_have() -> None:
    """Of five corners, the second picture shares three with the first, two of which moved by 10 px; the third shares
    none."""
    corners_px = np.zeros((4, 5, 2))
    corners_px[1, :, 0] = np.nan, np.nan, 10, 10, 0
    corners_px[2, 2:] = np.nan
    corners_px[2, :2] = 1e3
    corners_px[3, 0, 1] = 50  # one of five: still the first
    assert _moved(corners_px, 10.0) == [0, 1, 2] and _moved(corners_px, 10.1) == [0, 2]


def test_a_lens_that_two_radial_terms_cannot_express_gets_a_third() -> None:
    """Without k3, that of a wide lens becomes an error of the other terms."""
    lens = estimate_lens("a", BOARD.corners_m, close_up(0.7, k3=-0.3), (1280, 720)).reliable_lens
    assert lens is not None and lens.K[0, 0] == pytest.approx(900, rel=0.002)
    assert lens.distortion[[0, 1, 4]] == pytest.approx([-0.2, 0.05, -0.3], abs=0.05)


def test_a_lens_that_images_corners_elsewhere_gets_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Noise in both directions, of which 128 unknowns take up a part, in 800 coordinates: 0.1 sqrt(2 (1 - 0.16)) px =
    0.13 px. With 0.7 px more, 0.92 px; the limit is 0.05 % of 1280 px, 0.64 px. A fisheye is no closer, even
    if it describes them."""
    monkeypatch.setattr(calibration_boards, "read_board_footage", lambda *_: None)
    noise = np.random.default_rng(2).normal(size=(20, 20, 2))
    for noise_px, rms_px, warned in ((0.0, 0.13, False), (0.45, 0.6, False), (0.7, 0.92, True)):
        corners_px = close_up(0.7) + noise_px * noise
        footage = BoardFootage(tmp_path / "extrinsic", BOARD, (0,), 1, {"a": corners_px}, {"a": (1280, 720)})
        lenses, words = calibration_boards._intrinsics(tmp_path, footage)
        assert not lenses["a"].fisheye
        off_px = float(words["a"].partition("corners off by ")[2].removesuffix(" px"))
        assert off_px == pytest.approx(rms_px, rel=0.05)
        assert ("extrinsic/a: corners are off by 0.9 px (RMS)" in caplog.text) == warned


def test_close_footage_gives_the_intrinsics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Footage that does not fix them leaves given ones, which take the size of the footage if they state none."""

    def footage(part: str, corners_px: np.ndarray) -> BoardFootage:
        seen_px, size_px = {"a": corners_px}, {"a": (1280, 720)}
        return BoardFootage(tmp_path / part, BOARD, tuple(range(len(corners_px))), 1, seen_px, size_px)

    read = {"extrinsic": footage("extrinsic", close_up(0.7)[:9]), "intrinsic": footage("intrinsic", close_up(0.7))}
    monkeypatch.setattr(calibration_boards, "read_board_footage", lambda _, part, *__: read[part])
    calibration = calibrate_from_boards(tmp_path)
    assert calibration.lenses["a"].K[0, 0] == pytest.approx(900, rel=0.005)
    assert calibration.intrinsics["a"].startswith("from intrinsic/: 20 pictures")
    read["intrinsic"] = footage("intrinsic", close_up(0.7)[:9])
    with pytest.raises(InputError, match="intrinsic/a: does not fix the intrinsics"):
        calibrate_from_boards(tmp_path)
    K, distortion = np.array([[901.0, 0, 640], [0, 901, 360], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0])
    for size_px in (None, (1280, 720)):
        write_cameras(tmp_path, [Lens("a", K, distortion, np.eye(3), np.zeros(3), size_px)], "easymocap")
        calibration = calibrate_from_boards(tmp_path)
        assert calibration.lenses["a"].K[0, 0] == 901 and calibration.lenses["a"].size_px == (1280, 720)
        assert calibration.intrinsics["a"].startswith(
            "given; not verified by the footage (pictures between which the board moved: 9"
        )
    write_cameras(tmp_path, [Lens("a", K, distortion, np.eye(3), np.zeros(3), (640, 360))], "easymocap")
    with pytest.raises(InputError, match="extrinsic/a: is 1280 x 720 px, but its intrinsics are for 640 x 360"):
        calibrate_from_boards(tmp_path)
    read["intrinsic"] = footage("intrinsic", close_up(0.7))
    assert calibrate_from_boards(tmp_path).intrinsics["a"].startswith("from intrinsic/: 20 pictures")


@pytest.mark.parametrize("kind", ["easymocap", "caliscope"])
def test_intrinsics_are_read_from_files_without_poses(tmp_path: Path, kind: str) -> None:
    """The folder also has calibration/ with board footage, like the Pose2Sim layout."""
    (tmp_path / "calibration" / "extrinsic").mkdir(parents=True)
    given = Lens("cam_7", np.diag([900.0, 900, 1]), np.zeros(5), np.eye(3), np.zeros(3), (1000, 1000))
    write_cameras(tmp_path, [given], kind)
    (tmp_path / "extri.yml").unlink(missing_ok=True)
    if kind == "caliscope":
        path = tmp_path / "camera_array.toml"
        lines = [line for line in path.read_text().splitlines() if not line.startswith(("rotation =", "translation"))]
        text = "\n".join(lines).replace("[cameras.7]", "[cameras.0]")
        other = text.replace("[cameras.0]", "[cameras.1]").replace("= false", "= true")
        path.write_text(f"{text}\n{other.replace('cam_id = 7', 'cam_id = 8')}")
    footage = BoardFootage(tmp_path, BOARD, (0,), 1, {"cam_7": np.full((1, 20, 2), np.nan)}, {"cam_7": (1000, 1000)})
    lenses, words = calibration_boards._intrinsics(tmp_path, footage)
    assert lenses["cam_7"].K[0, 0] == 900 and words["cam_7"].startswith("given; not verified")


@pytest.mark.parametrize(("pose2sim", "formats"), [(False, ()), (True, ()), (True, ("aniposelib", "colmap"))])
def test_lenses_estimated_from_the_person_are_not_given_ones(
    tmp_path: Path, pose2sim: bool, formats: tuple[str, ...]
) -> None:
    """They would beat those of the extrinsic footage. Pose2Sim's file has no mark, nor have others beside it."""
    K, here = np.diag([500.0, 500, 1]), (np.zeros(5), np.eye(3), np.zeros(3), (1280, 720))
    lenses = [Lens("a", K, *here, estimated=True), Lens("b", K, *here)]
    write_calibration(tmp_path, lenses, "person", formats, pose2sim)
    footage = BoardFootage(tmp_path / "extrinsic", BOARD, (0,), 1, {"a": close_up(0.7)}, {"a": (1280, 720)})
    found, words = calibration_boards._intrinsics(tmp_path, footage)
    assert found["a"].K[0, 0] == pytest.approx(900, rel=0.005) and words["a"].startswith("from extrinsic/: 20 pictures")
    assert list(calibration_boards._given_lenses(tmp_path)) == ([] if pose2sim else ["b"])


def test_the_board_in_the_ground_frame_defines_the_floor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the last frame the board lies flat under cameras that look down on it, so z must be their height."""
    cameras = rig()
    corners_px = seen(cameras, {})
    flat = np.diag([1.0, -1, -1]), np.array([-0.1, 0.1, 0.8])  # z down, at the height of 0.8 m
    for i, camera in enumerate(cameras):
        corners_px[i, -2] = np.nan  # while it is put down, nobody sees it
        corners_px[i, -1] = camera.project(BOARD.corners_m @ flat[0].T + flat[1])[0]
    intrinsics = {c.name: Lens(c.name, c.K, np.zeros(4), np.eye(3), np.zeros(3), (1000, 1000)) for c in cameras}
    frames = tuple(range(100, 100 + FRAMES))
    found = dict(zip("abc", corners_px, strict=True))
    footage = BoardFootage(tmp_path, BOARD, frames, 1, found, dict.fromkeys("abc", (1000, 1000)))
    read = {"extrinsic": footage, "intrinsic": None}
    looked_for: list[int] = []

    def read_footage(_: Path, part: str, *wanted: int) -> BoardFootage | None:
        looked_for.extend(wanted)
        return read[part]

    monkeypatch.setattr(calibration_boards, "read_board_footage", read_footage)
    monkeypatch.setattr(calibration_boards, "_intrinsics", lambda *_: (intrinsics, dict.fromkeys("abc", "given")))
    calibration = calibrate_from_boards(tmp_path, ground_frame=100 + FRAMES - 1)
    assert looked_for == [100 + FRAMES - 1]
    for camera, lens in zip(cameras, calibration.lenses.values(), strict=True):
        assert -lens.R.T @ lens.t_m == pytest.approx(camera.centre_m - flat[1], abs=0.005)
    assert compare_pairs(cameras, calibration.fit.cameras)["a-c"]["turned_deg"] < 0.1
    with pytest.raises(InputError, match="no board in frame 7"):
        calibrate_from_boards(tmp_path, ground_frame=7)
    calibration.save(tmp_path / "out")
    written = EasyMocap(tmp_path / "out").lenses()
    assert written["b"].t_m == pytest.approx(calibration.lenses["b"].t_m) and (tmp_path / "out" / "boards.png").exists()
    calibration.save(tmp_path / "pose2sim", pose2sim=True)
    layout = recognise(tmp_path / "pose2sim")
    assert isinstance(layout, Pose2Sim)
    assert layout.lenses()["b"].t_m == pytest.approx(calibration.lenses["b"].t_m)


@pytest.mark.parametrize("older", ["colmap", "caliscope", "aniposelib", "easymocap", None])
def test_new_cameras_are_the_ones_that_are_read_once_they_are_copied(tmp_path: Path, older: str | None) -> None:
    """A calibration that precedes Pose2Sim's in the order of layouts would hide its file."""
    folder, out = tmp_path / "film", tmp_path / "cameras"
    (folder / "pose").mkdir(parents=True)
    old, new = (Lens("a", np.diag([f, f, 1.0]), np.zeros(5), np.eye(3), np.zeros(3), (64, 48)) for f in (50, 60))
    if older:
        write_cameras(folder, [old], older)
    write_calibration(out, [new], "boards", (), _is_pose2sim(folder))
    shutil.copytree(out, folder, dirs_exist_ok=True)  # what the command says to do to use the cameras
    layout = recognise(folder)
    assert [lens.K[0, 0] for lens in layout.lenses().values()] == [60]
    assert isinstance(layout, Pose2Sim if older is None else EasyMocap)


@pytest.mark.parametrize("older", [("easymocap", "colmap"), ("caliscope",), ("aniposelib",), ()])
def test_what_would_hide_the_cameras_of_a_fisheye_is_named(tmp_path: Path, older: tuple[str, ...]) -> None:
    """They cannot be in `intri.yml` and `extri.yml`, which precede all other files."""
    folder, out = tmp_path / "film", tmp_path / "cameras"
    folder.mkdir()
    old = Lens("a", np.diag([50.0, 50, 1]), np.zeros(4), np.eye(3), np.zeros(3), (64, 48))
    for layout in older:
        write_cameras(folder, [old], layout)
    write_calibration(out, [dataclasses.replace(old, fisheye=True)], "boards", (), False)
    advice = f"cameras: {out}; copy its files into {folder} to use them"
    files = {"easymocap": ["extri.yml", "intri.yml"], "colmap": ["sparse"], "caliscope": ["camera_array.toml"]}
    if hiding := [folder / name for layout in older for name in files.get(layout, [])]:
        advice += f"; remove {' and '.join(map(str, hiding))}, which would be read instead"
    assert _advice(out, folder) == advice
    for number, path in enumerate(hiding):
        path.rename(tmp_path / f"removed-{number}")
    shutil.copytree(out, folder, dirs_exist_ok=True)
    assert [lens.fisheye for lens in recognise(folder).lenses().values()] == [True]


def test_a_board_found_in_few_images_is_refused_as_the_wrong_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = dict.fromkeys("ab", np.full((9, len(BOARD.corners_m), 2), np.nan))
    found["a"] = seen(rig(), {})[0, :9].copy()
    found["a"][2:] = np.nan
    footage = BoardFootage(tmp_path, BOARD, tuple(range(9)), 1, found, dict.fromkeys("ab", (1000, 1000)))
    monkeypatch.setattr(calibration_boards, "read_board_footage", lambda *_: footage)
    with pytest.raises(InputError, match="this board was found in 2 of 18 pictures; check its columns"):
        calibrate_from_boards(tmp_path)


@pytest.mark.parametrize(("off_px", "agree"), [(2.5, True), (3.5, False)])
def test_cameras_that_do_not_see_one_board_are_refused(
    off_px: float, agree: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when one was started some frames later. Images are 1000 px wide."""
    cameras = rig()[:2]
    found = dict(zip("ab", seen(cameras, {}), strict=True))
    footage = BoardFootage(tmp_path, BOARD, tuple(range(FRAMES)), 1, found, dict.fromkeys("ab", (1000, 1000)))
    lenses = {c.name: Lens(c.name, c.K, np.zeros(4), np.eye(3), np.zeros(3), (1000, 1000)) for c in cameras}

    def solved(cameras: list[Camera], corners: BoardCorners) -> BoardFit:
        off = np.array([0.5, off_px])[:, None, None, None] * [0.6, 0.8]
        boards = Poses(np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3)))
        return BoardFit(cameras, boards, corners.corners_px, corners.corners_px + off, np.zeros((2, FRAMES)))

    monkeypatch.setattr(calibration_boards, "read_board_footage", lambda *_: footage)
    monkeypatch.setattr(calibration_boards, "_intrinsics", lambda *_: (lenses, dict.fromkeys("ab", "given")))
    monkeypatch.setattr(calibration_boards.rig, "solve_rig", solved)
    refusal = nullcontext() if agree else pytest.raises(InputError, match=r"camera b: its corners are 3\.5 px from")
    with refusal:
        calibrate_from_boards(tmp_path)


@pytest.mark.soak
def test_real_footage_gives_the_shipped_cameras() -> None:
    folder = shared_capture("caliscope-charuco")
    calibration = calibrate_from_boards(folder)
    report = calibration.report()
    assert report["rms_px"] < 0.5
    cameras = report["cameras"].values()
    assert sum(c["of_these_found"] for c in cameras) > 0.8 * sum(c["board_visible"] for c in cameras) > 160
    shipped = [Camera(lens.name, lens.K, lens.R, lens.t_m, 1280, 720) for lens in Caliscope(folder).lenses().values()]
    pairs = compare_pairs(shipped, calibration.fit.cameras)
    assert len(pairs) == 6 and all(p["turned_deg"] < 2 and p["moved_cm"] < 3 for p in pairs.values())
