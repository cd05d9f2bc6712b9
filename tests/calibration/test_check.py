import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hnerf.calibration.bundle import zoomed
from hnerf.calibration.calibrated import load_cameras
from hnerf.calibration.check import _change_reasons, _height_notes, _rounded, check_calibration
from hnerf.calibration.diagnosis import (
    MISTAKES,
    body_height_m,
    cost_without_each_px,
    crossed_points,
    likely_unit,
    size_ratio,
    trimmed_cost_px,
)
from hnerf.capture.capture import Capture
from hnerf.capture.sides import PARTS
from hnerf.config import CalibrationSettings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import STANDING_M, detections, ring, true_error_px, turned, walk_m, write_capture

SETTINGS = CalibrationSettings()
SHIFT_PX = np.array([[0, 0, 20_000.0], [0, 0, 0], [0, 0, 0]])
Mistake = Callable[[Camera], Camera]


pytestmark = pytest.mark.usefixtures("no_pictures")


def recorded_with(
    root: Path, mistake: Mistake, only: int | None = None, count: int = 4, noise_px: float = 2
) -> Capture:
    """Return the walk as recorded by a ring of cameras, with a mistake in the calibration of one of them or of all."""
    cameras = ring(count)
    wrong = [mistake(camera) if only in (None, i) else camera for i, camera in enumerate(cameras)]
    return write_capture(root, wrong, detections(cameras, noise_px))


def test_body_height_by_hand() -> None:
    # The figure's limb chain is .43 + .43 + .50 + |(.05, .194)| = 1.560 m; over 0.87 that is 1.79 m.
    assert body_height_m(STANDING_M[None]) == pytest.approx((0.43 + 0.43 + 0.5 + np.hypot(0.05, 0.194)) / 0.87)


def test_points_between_two_cameras_facing_each_other_have_no_depth() -> None:
    """The nose is on the line between them, 4 m from either; the neck is 1 m above it, where their lines of sight cross
    at 2 atan(1 / 4) = 28 degrees. A third camera, at right angles, first sees the neck alone, then both."""
    cameras = [
        dataclasses.replace(ring(1)[0], R=np.eye(3), t_m=-np.array(centre_m))
        for centre_m in ([4.0, 0, 1], [-4.0, 0, 1], [0, 4.0, 1])
    ]
    points_m = np.full((1, 25, 3), np.nan)
    points_m[0, :2] = [0, 0, 1], [0, 0, 2]
    seen = np.ones((3, 1, 25, 3))
    seen[2, 0, 0, 2] = 0
    for count in (2, 3):
        found = crossed_points(cameras[:count], seen[:count], points_m)
        assert np.isnan(found[0, 0]).all() and found[0, 1].tolist() == [0, 0, 2]
    seen[2, 0, 0, 2] = 1
    assert crossed_points(cameras, seen, points_m)[0, 0].tolist() == [0, 0, 1]


def test_cameras_facing_each_other_do_not_suggest_another_unit(tmp_path: Path) -> None:
    """With errors of 8 px, the person of 1.79 m would be 1.97 m tall if the points between the cameras were used."""
    cameras = ring(2)
    report = check_calibration(write_capture(tmp_path, cameras, detections(cameras, 8)), SETTINGS)
    assert report.after is not None and report.after.body_height_m == pytest.approx(1.79, abs=0.1)


def test_units_by_hand() -> None:
    assert likely_unit(1790) == "millimetres"
    assert likely_unit(179) == "centimetres"
    assert likely_unit(70.5) == "inches"
    assert likely_unit(5) is None


def test_a_good_calibration_is_left_unchanged(tmp_path: Path) -> None:
    """Recordings may use any camera name, but OpenCV's own writer refuses brackets and spaces."""
    capture = recorded_with(tmp_path / "in", lambda c: dataclasses.replace(c, name=f"Camera ({c.name})"))
    report = check_calibration(capture, SETTINGS)
    assert report.verdict == "ok"
    assert report.after is not None
    assert report.after.body_height_m == pytest.approx(1.79, abs=0.02)
    assert report.notes == (f"the person is {report.after.body_height_m:.2f} m tall",)
    report.save(tmp_path / "out")
    used = load_cameras(tmp_path / "out", capture).cameras
    assert list(used) == list(capture.cameras)
    for name, camera in used.items():
        for field in ("K", "R", "t_m"):
            np.testing.assert_array_equal(getattr(camera, field), getattr(capture.cameras[name], field))


def test_a_world_that_is_not_upright_is_doubted(tmp_path: Path) -> None:
    """After turning the world by a right angle about x, what pointed along z points along -y."""
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # of the world: z to y
    fallen = [dataclasses.replace(camera, R=camera.R @ turn) for camera in ring(4)]
    capture = write_capture(tmp_path / "in", fallen, detections(ring(4), 2))
    report = check_calibration(capture, SETTINGS)
    (doubt,) = report.doubts
    assert doubt.startswith("the trunk mostly points along -y, not up (+z)")
    report.save(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "report.json").read_text())["doubts"] == [doubt]


def test_keypoints_all_at_one_point_are_refused(tmp_path: Path) -> None:
    cameras = ring(4)
    seen = detections(cameras, 2)
    seen[1, ..., :2] = seen[1, :, :1, :2]
    with pytest.raises(InputError, match=r"camera c1: keypoints of a person lie within 0\.0 px; detect them again"):
        check_calibration(write_capture(tmp_path, cameras, seen), SETTINGS)


def test_runs_that_differ_in_the_last_digits_write_the_same_files(tmp_path: Path) -> None:
    """Keypoints that differ by 1e-9 px imitate sums taken in another order. The artifact's content decides whether
    later stages can be reused, so its camera files must be the same, too."""
    written = []
    for name, nudge_px in (("one", 0.0), ("two", 1e-9)):
        turned_camera = [turned(camera, 1.0) if i == 2 else camera for i, camera in enumerate(ring(3))]
        seen = detections(ring(3), 2) + np.array([nudge_px, -nudge_px, 0])
        capture = write_capture(tmp_path / name, turned_camera, seen)
        check_calibration(capture, SETTINGS).save(tmp_path / name / "out")
        files = ("report.json", "intri.yml", "extri.yml")
        written.append([(tmp_path / name / "out" / file).read_text() for file in files])
    assert written[0] == written[1] and '"verdict": "refined"' in written[0][0]


def test_without_legs_the_stored_height_is_null(tmp_path: Path) -> None:
    """JSON has no NaN; every reader accepts null."""
    cameras = ring(4)
    seen = detections(cameras, 2)
    seen[:, :, [10, 11, 13, 14]] = 0
    check_calibration(write_capture(tmp_path / "in", cameras, seen), SETTINGS).save(tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "report.json").read_text(), parse_constant=pytest.fail)
    assert stored["body_height_m"] is None and stored["trimmed_cost_px"]["after"] > 0


@pytest.mark.parametrize(("noise_px", "status"), [(10, "suspect"), (20, "rejected")])
def test_a_camera_with_bad_detections_is_suspect_or_rejected(tmp_path: Path, noise_px: float, status: str) -> None:
    """No calibration explains bad detections: a camera that is still usable is kept and marked, others are left out."""
    cameras = ring(4)
    seen = detections(cameras, 2)
    seen[2] = detections(cameras, noise_px, seed=1)[2]
    capture = write_capture(tmp_path / "in", cameras, seen)
    report = check_calibration(capture, SETTINGS)
    assert report.verdict == report.verdicts["c2"].status == status
    report.save(tmp_path / "out")
    used = load_cameras(tmp_path / "out", capture)
    assert ("c2" in used.cameras) == ("c2" in used.train_cameras) == (status == "suspect")


def test_a_camera_that_faces_away_is_rejected(tmp_path: Path) -> None:
    """A few points are triangulated wrongly, in front of it and a few pixels from its keypoints. All others lie behind
    it, and count as the diagonal of its image off."""
    away = recorded_with(tmp_path, lambda camera: turned(camera, 180), only=0, noise_px=1)
    verdict = check_calibration(away, SETTINGS).verdicts["c0"]
    assert verdict.status == "rejected" and verdict.median_px == pytest.approx(1000 * np.sqrt(2))


def test_leave_one_out_names_the_turned_camera() -> None:
    for i in range(4):
        off = [turned(camera, 1.0) if j == i else camera for j, camera in enumerate(ring(4))]
        costs = cost_without_each_px(off, detections(ring(4), noise_px=2))
        assert min(costs, key=costs.__getitem__) == f"c{i}"


def test_one_turned_camera_is_named_and_refined(tmp_path: Path) -> None:
    # One degree at 1000 px focal length is 17 px.
    capture = recorded_with(tmp_path / "in", lambda c: turned(c, 1.0), only=2)
    assert true_error_px(capture.cameras["c2"], ring(4)[2]) == pytest.approx(17.5, abs=1)
    report = check_calibration(capture, SETTINGS)
    assert [verdict.status for verdict in report.verdicts.values()] == ["ok", "ok", "refined", "ok"]
    assert true_error_px(report.cameras["c2"], ring(4)[2]) < 1
    reasons_of = {name: " | ".join(verdict.reasons) for name, verdict in report.verdicts.items()}
    for part in ("an outlier", "turned by 1.0", "pose refined: held-out frames go from"):
        assert part in reasons_of["c2"]
    assert all("pose kept: refining it takes held-out frames from" in reasons_of[name] for name in ("c0", "c1", "c3"))
    assert all("offset in time" in text or "in step" in text for text in reasons_of.values())
    assert {"as given", "pose of c0 refined", "pose of c2 refined"} <= set(report.held_out_px)
    report.save(tmp_path / "out")
    used = load_cameras(tmp_path / "out", capture).cameras
    np.testing.assert_allclose(used["c2"].R, report.cameras["c2"].R, atol=1e-12)
    stored = json.loads((tmp_path / "out" / "report.json").read_text())
    assert stored["verdict"] == "refined"
    assert stored["cameras"]["c2"]["median_px"] < 4 < stored["cameras"]["c2"]["median_before_px"]


@pytest.mark.parametrize(("zoom", "lens"), [(1.0, ""), (1.01, ", focal length changed by +1.0 %")])
def test_rounding_is_not_reported_as_a_change_of_focal_length(zoom: float, lens: str) -> None:
    """Refined cameras have K rounded to 1e-4 px, and a calibration may have given 1000.00003."""
    given = dataclasses.replace(ring(1)[0], K=np.array([[1000.00003, 0, 499.5], [0, 1000, 499.5], [0, 0, 1]]))
    new = _rounded(zoomed(turned(given, 1.0), zoom))
    assert _change_reasons(given, new) == [f"turned by 1.00 degrees, moved by 0.0 cm{lens}"]


def test_a_camera_turned_by_ten_degrees_is_recovered(tmp_path: Path) -> None:
    report = check_calibration(recorded_with(tmp_path, lambda c: turned(c, 10.0), only=1), SETTINGS)
    assert true_error_px(report.cameras["c1"], ring(4)[1]) < 1


def test_a_camera_that_exchanges_left_and_right_is_used_and_named(tmp_path: Path) -> None:
    """Its keypoints would be off by a tenth of the person's height in the mean, and its calibration to blame."""
    seen = detections(ring(4), 1)
    for part in PARTS:
        for right, left in part:
            seen[3][:, [right, left]] = seen[3][:, [left, right]]
    report = check_calibration(write_capture(tmp_path, ring(4), seen), SETTINGS)
    assert [verdict.status for verdict in report.verdicts.values()] == ["ok"] * 4
    assert report.notes[0] == (
        "camera c3: left and right of arms or legs were exchanged in 12 of 12 images, and are put right"
    )


def test_when_all_cameras_are_refined_the_world_stays_in_place(tmp_path: Path) -> None:
    signs = iter([1, -1, 1, -1])
    capture = recorded_with(tmp_path, lambda c: turned(c, 0.8 * next(signs), axis=0), noise_px=1)
    report = check_calibration(capture, SETTINGS)
    assert {v.status for v in report.verdicts.values()} == {"refined"}
    assert report.after is not None
    assert max(report.after.median_px.values()) < 2
    # A motion of the whole rig cannot be known; as the errors cancel, points must stay within 2 cm.
    points_m = report.after.points_m
    assert np.median(np.linalg.norm(points_m - walk_m(), axis=-1)) < 0.02


@pytest.mark.parametrize("cause", list(MISTAKES))
def test_each_wrong_convention_is_named(tmp_path: Path, cause: str) -> None:
    make: dict[str, Mistake] = dict(MISTAKES)  # all but one are their own inverse
    make["T is the camera's centre"] = lambda c: dataclasses.replace(c, t_m=c.centre_m)
    with pytest.raises(InputError) as caught:
        check_calibration(recorded_with(tmp_path, make[cause]), SETTINGS)
    assert cause in str(caught.value)
    assert " or " not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("count", "ratio"), [(3, 0.25), (4, 0.64), (3, 1.5), (4, 2)])
def test_intrinsics_for_another_image_size_are_named(tmp_path: Path, count: int, ratio: float) -> None:
    """The image size is blamed, not the unit, although the person would be 0.4 to 8.5 m tall."""
    wrong = recorded_with(tmp_path, lambda c: dataclasses.replace(c, K=np.diag([ratio, ratio, 1]) @ c.K), count=count)
    with pytest.raises(InputError, match=r"images of different sizes \(K times [0-9.]+ would fit\)") as caught:
        check_calibration(wrong, SETTINGS)
    assert float(str(caught.value).split("times ")[1].split()[0]) == pytest.approx(1 / ratio, rel=0.02)


@pytest.mark.parametrize("count", [2, 3])
def test_a_camera_that_is_far_off_does_not_suggest_another_image_size(count: int) -> None:
    """With two cameras, scaling K by 0.74 would fit as well."""
    cameras = ring(count)
    seen = detections(cameras, 2)
    assert size_ratio([turned(cameras[0], 20), *cameras[1:]], seen) is None
    assert size_ratio(cameras, seen) is None


def test_images_of_another_size_are_scaled_about_their_corner() -> None:
    """For a person 31 px tall, keypoints may be off by 1.6 px. If images 5 times as large were scaled about the centre
    of the first pixel instead, keypoints would be off by (5 - 1) / 2 = 2 px."""
    cameras = [camera.resized(14, 14) for camera in ring(3)]
    seen = detections([camera.resized(70, 70) for camera in cameras], 0)
    assert size_ratio(cameras, seen[:, :2]) == pytest.approx(5)


def test_a_wrong_convention_in_one_camera_is_named(tmp_path: Path) -> None:
    report = check_calibration(recorded_with(tmp_path, MISTAKES["R is transposed"], only=3), SETTINGS)
    assert "R is transposed: undone" in report.verdicts["c3"].reasons
    assert true_error_px(report.cameras["c3"], ring(4)[3]) < 1


@pytest.mark.parametrize(
    ("changed", "only", "message"),
    [
        (lambda c: {"t_m": 1000 * c.t_m}, None, r"1793 m tall; .* millimetres; in capture.toml multiply .* by 0.001$"),
        (lambda c: {"t_m": 0.001 * c.t_m}, None, r"metres declared as millimetres; .* by 1000$"),
        (lambda c: {"K": c.K + SHIFT_PX}, None, "camera c0: principal point at 2050 % of the width .* multiply units"),
        (lambda c: {"R": ring(4)[1].R, "t_m": ring(4)[1].t_m}, 0, "c0 and c1 stand at one place"),
    ],
    ids=["millimetres", "metres for millimetres", "principal point, which no unit explains", "cameras at one place"],
)
def test_an_impossible_setup_is_named(
    tmp_path: Path, changed: Callable[[Camera], dict[str, np.ndarray]], only: int | None, message: str
) -> None:
    wrong = recorded_with(tmp_path, lambda c: dataclasses.replace(c, **changed(c)), only, noise_px=0)
    with pytest.raises(InputError, match=message):
        check_calibration(wrong, SETTINGS)


def test_an_unusual_height_is_noted_not_refused(tmp_path: Path) -> None:
    small = recorded_with(tmp_path, lambda c: dataclasses.replace(c, t_m=0.6 * c.t_m), noise_px=0)
    (note,) = check_calibration(small, SETTINGS).notes
    # 0.6 of the figure's 1.793 m; 1.7 / 1.076 = 1.58.
    assert note.startswith("the person is 1.08 m tall: if that is wrong, in capture.toml multiply units")
    assert float(note.split()[-1]) == pytest.approx(1.58, abs=0.01)


def test_a_stated_stature_tells_the_unit_and_which_heights_are_usual(tmp_path: Path) -> None:
    """The figure of 1.793 m, 0.2 times as large, is 0.359 m tall; a child of 1.2 m takes 3.35 times the unit."""
    small = recorded_with(tmp_path, lambda c: dataclasses.replace(c, t_m=0.2 * c.t_m), noise_px=0)
    with pytest.raises(InputError, match=r"0.3587 m tall; .* by 3.345$"):
        check_calibration(dataclasses.replace(small, stature_m=1.2), SETTINGS)
    assert _height_notes(1.2, 1.2) == ["the person is 1.20 m tall"]
    ((note,), (usual,)) = (_height_notes(1.45, stature_m) for stature_m in (1.8, None))
    assert note == usual + ': if that is wrong, in capture.toml multiply units ("m" is 1, "mm" 0.001) by 1.241'


def test_swapped_camera_files_are_explained_by_no_known_mistake(tmp_path: Path) -> None:
    cameras = ring(4)
    shuffled = [
        dataclasses.replace(cameras[1], name="c0"), dataclasses.replace(cameras[0], name="c1"), *cameras[2:]
    ]  # fmt: skip
    with pytest.raises(InputError, match="no known mistake explains it"):
        check_calibration(write_capture(tmp_path, shuffled, detections(cameras, 1)), SETTINGS)


def test_a_camera_that_never_shows_the_person_is_left_out_if_two_others_do(tmp_path: Path) -> None:
    cameras = ring(4)
    seen = detections(cameras, noise_px=1)
    seen[2] = 0
    capture = write_capture(tmp_path / "in", cameras, seen)
    report = check_calibration(capture, SETTINGS)
    assert [verdict.status for verdict in report.verdicts.values()] == ["ok", "ok", "rejected", "ok"]
    assert report.verdicts["c2"].reasons[0].startswith("never shows the person")
    report.save(tmp_path / "out")
    assert load_cameras(tmp_path / "out", capture).train_cameras == ("c0", "c1", "c3")
    with pytest.raises(InputError, match="no person found by any camera but c1"):
        check_calibration(dataclasses.replace(capture, train_cameras=("c1", "c2")), SETTINGS)


def test_an_image_size_mismatch_is_named(tmp_path: Path) -> None:
    capture = recorded_with(tmp_path, lambda c: c)
    capture = dataclasses.replace(capture, calibrated_sizes_px=capture.calibrated_sizes_px | {"c1": (1008, 1000)})
    report = check_calibration(capture, SETTINGS)
    assert report.verdicts["c1"].reasons[0].startswith("calibrated at 1008x1000, recorded at 1000x1000")
    assert report.verdicts["c1"].status == "ok"


def test_one_camera_is_judged_by_the_ground_and_the_report_names_what_is_not_checked(tmp_path: Path) -> None:
    capture = recorded_with(tmp_path / "in", lambda c: c, count=1)
    report = check_calibration(capture, SETTINGS)
    assert report.verdict == "ok" and report.evidence is None
    assert any("standing on world height 0 the person is 1.7" in r for r in report.verdicts["c0"].reasons)
    assert any("not checked with one camera" in note for note in report.notes)
    report.save(tmp_path / "out")
    assert load_cameras(tmp_path / "out", capture).train_cameras == ("c0",)


def test_a_rendered_capture_is_left_unchanged(wave: Capture) -> None:
    report = check_calibration(wave, SETTINGS)
    assert report.verdict == "ok"
    assert all(report.cameras[name] is camera for name, camera in wave.cameras.items())


def test_the_trimmed_cost_uses_every_view() -> None:
    """One camera looks backwards. Rejecting it would cost a quarter of its image's diagonal, 354 px, and no more."""
    cameras = ring(4)
    keypoints = detections(cameras, 0)
    assert trimmed_cost_px(cameras, keypoints) == pytest.approx(0, abs=1e-6)
    backwards = [turned(cameras[0], 180.0), *cameras[1:]]
    assert trimmed_cost_px(backwards, keypoints) > 400


def test_trimming_the_cost_does_not_drop_a_whole_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five cameras are 1 to 10 px off, with a mean of 4.5 px over the lowest eight errors, and one is 100 px off:
    (5 x 4.5 + 100) / 6. The lowest four fifths of all 60 errors together would leave that camera out."""
    cameras, off_px = ring(6), np.stack([*[np.arange(1.0, 11)] * 5, np.full(10, 100.0)])
    monkeypatch.setattr("hnerf.calibration.diagnosis.reprojection_px", lambda *_: off_px)
    assert trimmed_cost_px(cameras, detections(cameras, 0)[:, :2, :5]) == pytest.approx((5 * 4.5 + 100) / 6)
