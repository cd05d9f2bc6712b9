"""SMPL poses given with a recording as the start of a fit, of a made-up SMPL model and of anny."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body.body_model import body_model
from hnerf.body.fit import fit_body
from hnerf.body.fit_result import BodyFit
from hnerf.body.given_start import initial_pose_from_given
from hnerf.calibration.check import check_calibration
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.given_poses import GivenPoses
from hnerf.config import CalibrationSettings, FitSettings, SegmentationSettings
from hnerf.segmentation.segment import segment
from tests.body.made_up_smpl import write_smpl
from tests.body.recorded_body import RING, joints_m, moving_body, record, ring_camera, silhouettes

LIMBS = tuple(f"{bone}.{side}" for bone in ("upperarm01", "lowerarm01", "upperleg01", "lowerleg01") for side in "LR")
ENDS = tuple(f"{end}.{side}" for end in ("lowerarm01", "wrist", "lowerleg01", "foot") for side in "LR")


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_smpl(tmp_path_factory.mktemp("smpl") / "made_up.npz")


def parameters() -> GivenPoses:
    """Return three frames of a person who stands upright with arms down, one forearm and one knee bent, in a world with
    Z up; SMPL has Y up."""
    theta = np.zeros((3, 24, 3))
    theta[:, 16], theta[:, 17], theta[:, 18], theta[:, 5] = [0, 0, -1.2], [0, 0, 1.2], [0, -0.7, 0], [0.5, 0, 0]
    theta[:, 16, 2] += (0, 0.2, 0.4)
    root = np.tile(np.eye(4), (3, 1, 1))
    root[:, :3, :3], root[:, :3, 3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0.1, 0, 1.2]
    return GivenPoses(theta, root, np.array([0.5, -0.5, 0.5, *[0.0] * 7]))


def recorded(model_file: Path, folder: Path, given: GivenPoses) -> tuple[Capture, BodyFit]:
    """Record masks of the made-up person in the poses of `parameters()`, without keypoints but with the poses `given`,
    which may differ."""
    pose = initial_pose_from_given(parameters(), body_model(FitSettings(body_model=model_file)), (0, 1, 2))
    truth = BodyFit(pose.rig.to(dtype=torch.float32), (0, 1, 2), pose.theta.float(), pose.root.float())
    capture = record(folder, truth, RING, tuple(RING))
    (folder / "keypoints.npz").unlink()
    given.save(folder / "poses.npz")
    return capture, truth


def test_frames_without_a_given_pose_take_that_of_the_nearest_frame(model_file: Path) -> None:
    """The first frame is unknown; then the middle one, one row away from both others but nearer in time to the last."""
    model = body_model(FitSettings(body_model=model_file))
    for unknown, frames, taken, other in ((0, (0, 1, 2), 1, 2), (1, (0, 8, 9), 2, 0)):
        given = parameters()
        given.theta[unknown], given.root[unknown] = np.nan, np.nan
        pose = initial_pose_from_given(given, model, frames)
        assert torch.equal(pose.theta[unknown], pose.theta[taken]) and torch.equal(pose.root[unknown], pose.root[taken])
        assert not torch.equal(pose.theta[taken], pose.theta[other])


def test_a_frame_without_a_given_pose_is_no_evidence_for_that_of_another(model_file: Path, tmp_path: Path) -> None:
    """The person moves by 2 cm a frame. In the middle frame only the motion, which the fit trusts little here, tells
    where."""
    given = parameters()
    given.theta[1], given.root[1] = np.nan, np.nan
    given.root[2, 0, 3] += 0.04
    capture, _ = recorded(model_file, tmp_path, given)
    fit, report = fit_body(capture, None, FitSettings(body_model=model_file, acceleration_mps2=100.0))
    first, middle, last = joints_m(fit)[:, 0, 0].tolist()
    assert last - first == pytest.approx(0.04, abs=0.002) and middle - first == pytest.approx(0.02, abs=0.002)
    assert report["keypoint_residual_px"][1] is None


def test_outlines_correct_given_poses_without_keypoints(model_file: Path, tmp_path: Path) -> None:
    """The given poses are 3 cm off, with arms 0.15 rad too high."""
    wrong = parameters()
    wrong.root[:, 0, 3] += 0.03
    wrong.theta[:, 16, 2] += 0.15
    wrong.theta[:, 17, 2] -= 0.15
    capture, truth = recorded(model_file, tmp_path, wrong)
    settings = FitSettings(body_model=model_file, contour_steps=4)
    begin = initial_pose_from_given(wrong, body_model(settings), (0, 1, 2))
    fit, report = fit_body(capture, silhouettes(capture, truth), settings)
    before, after = ((joints_m(body) - joints_m(truth))[:, truth.rig.free].norm(dim=-1) for body in (begin, fit))
    assert float(before.mean()) > 0.03 and float(after.mean()) < 0.008
    assert report["given_poses"] == "used as the start, and in place of keypoints, which are missing"


def test_calibration_check_and_segmentation_work_without_keypoints(model_file: Path, tmp_path: Path) -> None:
    """Cameras are used as given and reported as unchecked. Of the given masks, only the person is kept."""
    capture, truth = recorded(model_file, tmp_path, parameters())
    masks = silhouettes(capture, truth)
    for name in capture.train_cameras:
        for frame in capture.frames:
            given = np.where(masks.get(name, frame), 255, 0).astype(np.uint8)
            given[:10, :10] = 255  # something other than the person
            write_image(tmp_path / "masks" / name / f"{frame:06d}.png", given)
    report = check_calibration(capture, CalibrationSettings())
    assert report.verdict == "ok" and report.cameras == capture.cameras
    assert report.notes[0].startswith("not checked: the recording has no keypoints")
    report.save(tmp_path / "calibration")
    rough, _ = fit_body(capture, None, FitSettings(body_model=model_file))
    assert float((joints_m(rough) - joints_m(truth)).norm(dim=-1).mean()) < 0.01
    found = segment(capture, rough, SegmentationSettings())
    assert all(np.array_equal(found.get(c, f), masks.get(c, f)) for c in capture.train_cameras for f in capture.frames)


def test_given_poses_are_transferred_to_anny_by_corresponding_joints(model_file: Path) -> None:
    """Limbs start from the same hips and point in the same directions within a few degrees; the made-up T pose differs
    a little from the mean one."""
    smpl, anny = (
        initial_pose_from_given(parameters(), body_model(FitSettings(body_model=m)), (0, 1, 2))
        for m in (model_file, "anny")
    )
    ways = []
    for pose in (smpl, anny):
        start, end = ([pose.rig.joint_names.index(name) for name in names] for names in (LIMBS, ENDS))
        way = joints_m(pose)[:, end] - joints_m(pose)[:, start]
        ways.append(way / way.norm(dim=-1, keepdim=True))
    angles_deg = torch.rad2deg(torch.arccos((ways[0] * ways[1]).sum(-1).clamp(-1, 1)))
    assert float(angles_deg.max()) < 8
    hips = [joints_m(pose)[:, pose.rig.joint_names.index("upperleg01.L")] for pose in (smpl, anny)]
    assert float((hips[0] - hips[1]).norm(dim=-1).max()) < 0.08


def test_anny_is_fitted_to_outlines_from_given_poses_alone(
    model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hnerf.body.fit.KEYPOINT_STEPS", 8)
    capture, truth = recorded(model_file, tmp_path, parameters())
    fit, report = fit_body(capture, silhouettes(capture, truth), FitSettings(contour_steps=2))
    wrists = [joints_m(body)[:, body.rig.joint_names.index("wrist.L")] for body in (fit, truth)]
    assert float((wrists[0] - wrists[1]).norm(dim=-1).max()) < 0.08 and min(report["silhouette_iou"]) > 0.7
    assert report["given_poses"].startswith("are SMPL's: used as the start, by corresponding joints")


def test_given_poses_that_are_all_unknown_count_as_none(tmp_path: Path) -> None:
    capture = record(tmp_path, moving_body((0, 1)), {"0": ring_camera("0", 0.0)}, ("0",))
    GivenPoses.unknown(2).save(tmp_path / "poses.npz")
    assert capture.given_poses() is None
