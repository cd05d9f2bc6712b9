from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body import contour_fit
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.body_model import BodyModel, body_model
from hnerf.body.fit import (
    _doubts_about_depth,
    _outlines,
    _report,
    _warn_of_stature,
    fit_body,
    initial_pose,
    resolve_depth_flips,
)
from hnerf.body.fit_result import BodyFit
from hnerf.body.ground import Ground
from hnerf.body.keypoint_fit import Problem, levenberg_marquardt, metres_per_pixel
from hnerf.body.observations import observe, runs
from hnerf.body.pose_prior import Smoothness
from hnerf.capture.capture import Capture
from hnerf.config import FitSettings
from hnerf.errors import InputError
from tests.body import recorded_body
from tests.body.recorded_body import (
    joints_m,
    moving_body,
    of_linear_model,
    problem_at,
    record,
    ring_camera,
    silhouettes,
    true_pose,
)
from tests.body.test_articulation import random_pose
from tests.body.two_bone import two_bone_rig
from tests.calibration.synthetic import edited_keypoints

RING = recorded_body.RING | {"test": ring_camera("test", 1.0)}


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop fits to keypoints early; the results are accurate enough for these tests."""
    monkeypatch.setattr("hnerf.body.fit.KEYPOINT_STEPS", 8)


def joint_error_m(a: BodyFit, b: BodyFit) -> torch.Tensor:
    """Return distances (n, free joints) between the joints of two fits."""
    return (joints_m(a) - joints_m(b)).norm(dim=-1)[:, a.rig.free]


@pytest.mark.usefixtures("few_steps")
def test_four_cameras_recover_pose_and_shape(tmp_path: Path) -> None:
    truth = moving_body((0, 1, 2))
    capture = record(tmp_path, truth, RING, ("0", "1", "2", "3"))
    fit, report = fit_body(capture, silhouettes(capture, truth), FitSettings(contour_steps=3))
    error_m = joint_error_m(fit, truth)
    assert error_m.mean() < 0.012 and error_m.max() < 0.04
    assert (fit.vertices_m() - truth.vertices_m()).norm(dim=-1).mean() < 0.012
    assert min(report["silhouette_iou"]) > 0.94 and report["poor_frames"] == [] and "doubts" not in report
    assert max(report["keypoint_residual_px"]) < 2
    assert abs(report["stature_m"] - float(np.ptp(truth.rig.vertices_m[:, 2].numpy()))) < 0.02
    assert fit.frames == (0, 1, 2) and not fit.theta[:, ~fit.rig.free].any()


def test_distance_maps_of_outlines_stay_within_their_memory_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = moving_body((0, 1))
    capture = record(tmp_path, truth, RING, ("0", "1", "2", "3"))
    width_px, height_px = capture.cameras["0"].size_px
    whole = 2 * 4 * width_px * height_px * 4  # frames, cameras, pixels, bytes
    for given, stride in ((whole, 1), (whole - 1, 2), (whole // 4, 2), (whole // 4 - 1, 3)):
        monkeypatch.setattr("hnerf.body.fit.DISTANCE_BYTES", given)
        edges = _outlines(capture, silhouettes(capture, truth), torch.full((4, 2), 0.01), 0.05)
        assert [[edge.stride for edge in row if edge] for row in edges] == [[stride] * 4] * 2


def test_a_frame_without_observations_is_reported_as_poor(tmp_path: Path) -> None:
    """Frame 1 has no keypoints. Without masks it is poor; with masks, they decide."""
    truth = moving_body((0, 1, 2))
    capture = record(tmp_path, truth, RING, ("0", "1"))
    seen = observe(capture)
    seen.confidence[:, 1] = 0
    pose = true_pose(truth)
    masks = silhouettes(capture, truth)
    reports = [_report(capture, m, seen, pose, truth, {}) for m in (None, masks)]  # type: ignore[arg-type]
    assert [report["keypoint_residual_px"][1] for report in reports] == [None, None]
    assert [report["poor_frames"] for report in reports] == [[1], []]


def test_one_camera_finds_the_depth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At first only the lower foot stands on the ground. Once the pose is known, each foot does: before the six steps
    on outlines, and in them."""
    truth, stands, each_foot = moving_body((0, 1, 2, 3)), Ground.add, []
    monkeypatch.setattr(Ground, "add", lambda self, *given: each_foot.append(self.each_foot) or stands(self, *given))
    capture = record(tmp_path, truth, RING, ("0",))
    fit, report = fit_body(capture, silhouettes(capture, truth), FitSettings(contour_steps=6))
    assert each_foot == sorted(each_foot) and not each_foot[0] and sum(each_foot) > 6
    assert joint_error_m(fit, truth).mean() < 0.06
    assert fit.vertices_m()[..., 2].min(1).values.mean() < 0.01  # bare feet stand on the ground
    (doubt,) = report["doubts"]  # the person does not turn around
    assert doubt.startswith("one camera does not determine the depth of limbs in 4 of 4 frames: ")


def test_there_is_no_doubt_about_depth_in_a_single_posture(caplog: pytest.LogCaptureFixture) -> None:
    assert _doubts_about_depth("ada", torch.tensor([True, True])) == [] and not caplog.records
    (doubt,) = _doubts_about_depth("ada", torch.tensor([True, False]))
    assert " in 1 of 2 frames: " in doubt and caplog.messages == [f"ada: {doubt}"]


@pytest.mark.usefixtures("few_steps")
def test_one_camera_finds_the_stature_if_height_0_is_not_the_ground(tmp_path: Path) -> None:
    """The world's origin is a board on a table, 0.7 m above the floor."""
    truth = moving_body((0, 1))
    capture = record(tmp_path, truth, RING, ("0",))
    below = capture.with_cameras({n: replace(c, t_m=c.t_m + c.R @ [0, 0, 0.7]) for n, c in capture.cameras.items()})
    _, report = fit_body(below, None, FitSettings())
    assert 1.6 < report["stature_m"] < 2.0  # near the prior


@pytest.mark.usefixtures("few_steps")
def test_a_stated_stature_overrides_the_ground(tmp_path: Path) -> None:
    """A person of 1.83 m is taken for a child of 1.4 m who is nearer to the camera, because `capture.toml` says so.
    Standing on height 0, the person would be 1.3 times as tall."""
    capture = replace(record(tmp_path, moving_body((0, 1)), RING, ("0",)), stature_m=1.4)
    _, report = fit_body(capture, None, FitSettings())
    assert not report["on_ground"] and abs(report["stature_m"] - 1.4) < 0.05


def test_an_unlikely_stature_from_one_camera_is_warned_about(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The limit is one and a half standard deviations: 1.72 m + 1.5 x 8 cm = 1.84 m."""
    settings = FitSettings(stature_m=1.72, stature_std_m=0.08)
    for stature_m, words in ((1.83, ""), (1.61, ""), (1.85, "1.85 m tall, 1.72 m expected")):
        caplog.clear()
        _warn_of_stature(stature_m, settings, stated=False)
        assert words in caplog.text and bool(words) == bool(caplog.text)


def test_the_stature_warning_depends_on_whether_one_was_stated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hnerf.body.fit.KEYPOINT_STEPS", 1)
    monkeypatch.setattr("hnerf.body.fit.MAX_STATURE_SIGMAS", 0)
    for stature_m, advice in ((None, "State their height"), (1.7, "1.70 m stated: do they stand on world height 0")):
        caplog.clear()
        fit_body(replace(record(tmp_path, moving_body((0, 1)), RING, ("0",)), stature_m=stature_m), None, FitSettings())
        assert [advice in text for text in caplog.messages if "m tall" in text] == [True]
        assert ("State their height" in caplog.text) == (stature_m is None)


@pytest.mark.usefixtures("few_steps")
def test_with_one_camera_the_soles_stand_on_the_ground(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contour_fit, "_sole_m", lambda *_: 0.03)
    truth = moving_body((0, 1))
    truth.root[:, 2, 3] += 0.03
    capture = record(tmp_path, truth, RING, ("0",))
    fit, _ = fit_body(capture, silhouettes(capture, truth), FitSettings(contour_steps=6))
    assert 0.015 < fit.vertices_m()[..., 2].min(1).values.mean() < 0.035


@pytest.mark.usefixtures("few_steps")
def test_an_arm_mirrored_in_depth_is_corrected_from_neighbouring_frames(tmp_path: Path) -> None:
    truth = moving_body((0, 1, 2))
    capture, pose = record(tmp_path, truth, RING, ("0",)), true_pose(truth)
    problem = of_linear_model(problem_at(pose, capture, 30.0, 0.1), pose.rig)
    pose = levenberg_marquardt(problem, pose, 15)
    mirrored_theta = pose.theta.clone()
    mirrored_theta[1, truth.rig.joint_names.index("upperarm01.L")] += torch.tensor([0.0, 2.0, 0.0])
    mirrored = levenberg_marquardt(problem, replace(pose, theta=mirrored_theta), 15)
    wrist = truth.rig.joint_names.index("wrist.L")

    def off_m(found: Pose) -> float:
        return float((joints_m(found) - joints_m(pose))[1, wrist].norm())

    assert off_m(mirrored) > 0.5  # descent alone does not leave this minimum
    mended = resolve_depth_flips(problem, mirrored, runs(capture))
    assert off_m(mended) < 0.02
    assert resolve_depth_flips(problem, mended, runs(capture)).theta.sub(mended.theta).abs().max() < 0.02


@pytest.mark.parametrize("cameras", [("0",), ("0", "1", "2", "3")])
@pytest.mark.usefixtures("few_steps")
def test_a_fit_to_keypoints_handles_an_isolated_frame_that_is_hardly_seen(
    tmp_path: Path, cameras: tuple[str, ...]
) -> None:
    """Frame 9 has no neighbours in time and stays near the others. It is seen by one camera of four, or, with a single
    camera, not at all."""
    truth = moving_body((0, 1, 9))
    capture = record(tmp_path, truth, RING, cameras)
    with edited_keypoints(tmp_path) as keypoints:
        for name in cameras[:1] if len(cameras) == 1 else cameras[1:]:
            keypoints[name][2] = 0
    fit, report = fit_body(capture, None, FitSettings())
    assert fit.frames == truth.frames and fit.root.isfinite().all()
    assert (fit.root[2, :3, 3] - fit.root[1, :3, 3]).norm() < 1.0
    assert len(cameras) == 1 or joint_error_m(fit, truth)[:2].mean() < 0.03
    assert report["silhouette_iou"] is None and "outlines" not in report["seconds"]


def test_a_person_seen_by_too_few_cameras_is_refused(tmp_path: Path) -> None:
    capture = record(tmp_path, moving_body((0, 1, 2)), RING, ("0", "1"))
    with edited_keypoints(tmp_path) as keypoints:
        keypoints["1"][1:, ..., 2] = 0
    with pytest.raises(InputError, match=r"keypoints.npz: head and trunk .* in only 1 of 3 frames"):
        fit_body(capture, None, FitSettings())
    (tmp_path / "keypoints.npz").unlink()
    with pytest.raises(InputError, match=r"no keypoints"):
        fit_body(capture, None, FitSettings())


def test_frames_before_the_person_enters_do_not_count(tmp_path: Path) -> None:
    capture = record(tmp_path, moving_body((0, 1, 2, 3, 4)), RING, ("0", "1"))
    with edited_keypoints(tmp_path) as keypoints:
        for seen in keypoints.values():
            seen[:3, ..., 2] = 0
    assert initial_pose(capture, observe(capture), body_model(FitSettings())).root.isfinite().all()


def test_a_frame_that_shows_too_little_starts_where_the_frame_nearest_in_time_does(tmp_path: Path) -> None:
    """Frame 20 is one row away from frame 1 and from frame 21."""
    capture = record(tmp_path, moving_body((0, 1, 20, 21)), RING, ("0", "1"))
    with edited_keypoints(tmp_path) as keypoints:
        for seen in keypoints.values():
            seen[2, ..., 2] = 0
    root = initial_pose(capture, observe(capture), body_model(FitSettings())).root
    assert torch.equal(root[2], root[3]) and not torch.equal(root[1], root[3])


@pytest.mark.parametrize(
    ("train", "novel", "expected"),
    [
        ((0, 1, 2, 5, 6), (), [(0, 1, 2), (5, 6)]),
        ((0, 5, 6), (1, 2), [(0, 1, 2), (5, 6)]),
        ((0,), (1, 2, 5, 6), [(0,), (1, 2), (5, 6)]),
        ((0, 3, 6, 15, 18), (), [(0, 3, 6), (15, 18)]),
        ((0, 2, 6, 8, 10, 15, 16), (), [(0, 2, 6, 8, 10), (15, 16)]),
    ],
)
def test_runs_break_at_gaps_and_between_two_splits(
    train: tuple[int, ...], novel: tuple[int, ...], expected: list[tuple[int, ...]]
) -> None:
    """The last case has gaps of 2, 4, 2, 2, 5 and 1, with a median of 2. A gap of 4 is twice that and continues a run;
    a gap of 5 is more and ends it."""
    assert runs(Capture("ada", Path(), {}, (), (), train, novel, 25.0, "z", {}, {})) == expected


def test_the_normal_equations_contain_the_gradient_of_the_cost(tmp_path: Path) -> None:
    """The gradient along a random direction through poses, shape and offsets agrees with central differences."""
    capture = record(tmp_path, moving_body((0, 1, 2)), RING, ("0", "1"))
    rig, seen = two_bone_rig(), observe(capture)

    pose, one = random_pose(rig, 3), torch.ones(1, dtype=torch.float64)
    model = BodyModel(lambda _: rig, 0 * one, one, -9 * one, 9 * one, one.bool(), torch.zeros(0), is_smpl=False)
    settings = FitSettings(keypoint_m=0.02, keypoint_outlier_m=0.5, offset_m=0.02, stature_m=2.0, stature_std_m=0.1)
    rough = Smoothness([(0, 1, 2)], 25.0, np.full(25, 1e9))
    problem = Problem(seen, metres_per_pixel(seen.cameras, pose), model, settings, rough)
    generator = torch.Generator().manual_seed(0)
    frame, shared = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in ((3, 9), (76,)))
    ends = []
    for step in (1e-6, -1e-6):
        end = Articulation(rig).apply_step(pose, step * frame)
        offsets_m = pose.offsets_m + step * shared[1:].reshape(25, 3)
        ends.append(replace(end, rig=rig.reshaped(rig.beta + step * shared[:1]), offsets_m=offsets_m))
    for fitted in (problem, replace(problem, in_space=True)):
        _, equations = fitted.assemble(pose)
        slope = float((equations.frame_gradient * frame.numpy()).sum() + equations.shared_gradient @ shared.numpy())
        above, below = (fitted.assemble(end)[0] for end in ends)
        np.testing.assert_allclose(
            slope, (above - below) / 2e-6, rtol=5e-3
        )  # the prior's axes, which turn with the shape, are held fixed
