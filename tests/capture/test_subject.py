"""Choice of the subject among people at known positions: passers-by, a poster, a mirror image."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture import people
from hnerf.capture.capture import Capture, SubjectPoint
from hnerf.capture.subject import ranked_people, subject_keypoints
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import STANDING_M, detections, edited_keypoints, ring, turned, walk_m, write_capture

_AGREED = people._agreements
FRAMES, CONFIDENCE, NOISE_PX = 30, 0.8, 1.0


def seen_by(camera: Camera, joints_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return detections (frames, 25, 3) of joints (frames, 25, 3): zeros if most are outside the image."""
    uv, depth_m = camera.project(joints_m)
    noisy = uv + rng.normal(size=uv.shape) * NOISE_PX
    inside = ((noisy >= 0) & (noisy < camera.width_px)).all(-1) & (depth_m > 0)
    whole = inside.mean(-1, keepdims=True) > 0.5
    return np.concatenate([noisy, np.full_like(uv[..., :1], CONFIDENCE)], -1) * (inside & whole)[..., None]


def recorded(root: Path, cameras: list[Camera], *people_m: np.ndarray) -> tuple[Capture, list[dict[str, np.ndarray]]]:
    """Write a capture of people, each (frames, 25, 3) in metres, whose order differs from image to image. Return it and
    the detections of each person."""
    rng = np.random.default_rng(0)
    each = [{camera.name: seen_by(camera, joints_m, rng) for camera in cameras} for joints_m in people_m]
    mixed = []
    for camera in cameras:
        together = np.stack([one[camera.name] for one in each], 1)
        mixed.append([frame[rng.permutation(len(each))] for frame in together])
    return write_capture(root, cameras, np.array(mixed)), each


def walking(start_m: tuple[float, float], end_m: tuple[float, float]) -> np.ndarray:
    """Return joints (frames, 25, 3) of somebody who walks in a line, swinging arms and legs."""
    share = np.linspace(0, 1, FRAMES)[:, None, None]
    joints_m = np.repeat(STANDING_M[None], FRAMES, 0)
    swing = 0.2 * np.sin(2 * np.pi * np.arange(FRAMES) / 10)[:, None]
    joints_m[:, [3, 4, 11], :2] += swing[..., None]  # forwards and sideways: every camera sees it
    joints_m[:, [6, 7, 14], :2] -= swing[..., None]
    ends = np.array([[*start_m, 0], [*end_m, 0]])
    return joints_m + ends[0] + share * (ends[1] - ends[0])


def staying(at_m: tuple[float, float]) -> np.ndarray:
    return walking(at_m, at_m)


def share_right(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> float:
    """Return the share of images in which the person was found, among those that show the person."""
    right = [
        np.array_equal(a, b)
        for name in expected
        for a, b in zip(found[name], expected[name], strict=True)
        if b[:, 2].any()
    ]
    return float(np.mean(right))


@pytest.mark.parametrize("cameras", [1, 4])
def test_a_passer_by_is_not_taken_for_the_subject(cameras: int, tmp_path: Path) -> None:
    """The passer-by comes nearer to some cameras than the subject, and passes the subject at 0.6 m."""
    capture, (subject, _) = recorded(tmp_path, ring(cameras), walk_m(FRAMES), walking((0.5, -2.5), (1.3, 2.5)))
    assert share_right(subject_keypoints(capture), subject) == 1


def test_two_people_who_cross_are_told_apart(tmp_path: Path) -> None:
    """Both walk through the middle, 0.4 m apart; the second comes late and leaves early."""
    first, second = walking((-1.2, -0.2), (1.2, -0.2)), walking((1.2, 0.2), (-1.2, 0.2))
    second[:5] = second[-5:] = 100.0  # elsewhere
    capture, (subject, other) = recorded(tmp_path, ring(4), first, second)
    people = ranked_people(capture)
    names = capture.train_cameras
    assert share_right(dict(zip(names, people[0].keypoints, strict=True)), subject) > 0.97
    assert share_right(dict(zip(names, people[1].keypoints, strict=True)), other) > 0.9


def test_people_who_are_most_prominent_in_turn_are_told_apart(tmp_path: Path) -> None:
    """They are 1.6 m apart. One camera misses each of them in every other frame, and the other person in the next."""
    cameras = ring(4)
    _, each = recorded(tmp_path, cameras, walking((-1.2, -0.8), (1.2, -0.8)), walking((1.2, 0.8), (-1.2, 0.8)))
    for first, person in enumerate(each):
        person["c0"][first::2] = 0
    found = people.follow_people(cameras, [np.stack([one[c.name] for one in each], 1) for c in cameras])
    tracks = [dict(zip(each[0], track.keypoints, strict=True)) for track in found]
    for person in each:
        assert max(share_right(track, person) for track in tracks) > 0.97


@pytest.mark.parametrize("cameras", [1, 4])
def test_a_poster_is_not_taken_for_the_subject(cameras: int, tmp_path: Path) -> None:
    """It hangs in the middle, larger than the subject, and never moves."""
    poster = np.repeat(1.15 * STANDING_M[None], FRAMES, 0)
    capture, (subject, _) = recorded(tmp_path, ring(cameras), staying((-0.9, 0.3)), poster)
    assert share_right(subject_keypoints(capture), subject) == 1
    assert [person.moves for person in ranked_people(capture)] == [True, False]


def test_a_motionless_person_alone_is_the_subject(tmp_path: Path) -> None:
    """With nobody else there, it may be a person who stands still."""
    capture, (subject, _) = recorded(
        tmp_path, ring(3), np.repeat(STANDING_M[None], FRAMES, 0), np.full((FRAMES, 25, 3), 100.0)
    )
    assert share_right(subject_keypoints(capture), subject) == 1


def test_a_mirror_image_is_not_taken_for_the_subject(tmp_path: Path) -> None:
    """One camera sees the subject larger in a mirror in front of it; no other camera sees anybody there."""
    cameras = ring(4)
    capture, (subject,) = recorded(tmp_path, cameras, walk_m(FRAMES))
    rng = np.random.default_rng(1)
    towards = cameras[0].centre_m * [0.3, 0.3, 0]
    mirrored = seen_by(cameras[0], walk_m(FRAMES) * [1, -1, 1] + towards, rng)
    with edited_keypoints(tmp_path) as seen:
        seen["c0"] = np.stack([mirrored, subject["c0"]], 1)
    assert share_right(subject_keypoints(capture), subject) == 1


def test_cameras_without_poses_choose_the_subject_independently(tmp_path: Path) -> None:
    """All cameras stand at the origin; in each, a stranger walks by farther away than the subject."""
    cameras = ring(3)
    far = np.stack([walking((-2.5, 2), (-2.5, -2)), walking((2, 2.5), (-2, 2.5)), walking((2, -2.5), (-2, -2.5))])
    capture, (subject, *_) = recorded(tmp_path, cameras, walk_m(FRAMES), *far)
    nowhere = {c.name: dataclasses.replace(c, R=np.eye(3), t_m=np.zeros(3)) for c in cameras}
    assert share_right(subject_keypoints(dataclasses.replace(capture, cameras=nowhere)), subject) > 0.9


def test_in_a_crowd_only_the_most_prominent_people_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of two images shows 64 people; the last is twice as tall as the others."""
    counts = []
    monkeypatch.setattr(
        people, "_agreements", lambda cameras, found: counts.append([*map(len, found)]) or _AGREED(cameras, found)
    )
    cameras = ring(2)
    images = []
    for camera in cameras:
        seen = seen_by(camera, STANDING_M[None], np.random.default_rng(0))
        small = seen * (0.5, 0.5, 1)
        images.append(np.stack([*[small] * 63, seen], 1))
    best = people.follow_people(cameras, images)[0]
    assert counts[0] == [12, 12]
    assert all(np.array_equal(found, image[:, 63]) for found, image in zip(best.keypoints, images, strict=True))


def test_two_equally_likely_subjects_are_refused(tmp_path: Path) -> None:
    capture, _ = recorded(tmp_path, ring(1), staying((0, -0.6)), staying((0, 0.6)))
    with pytest.raises(InputError, match=r"equal claim.*at \(\d+, \d+\) and \(\d+, \d+\) in camera c0, frame 0; name"):
        subject_keypoints(capture)


def test_equally_likely_subjects_are_reported_in_recorded_pixels(tmp_path: Path) -> None:
    """The recorded image is 8 times as large: pixel 400 covers its pixels 3200 to 3207, whose middle is 3203.5."""
    x, y, seen = np.linspace(-20, 20, 25), np.linspace(-50, 50, 25), np.full(25, CONFIDENCE)
    moving = [np.stack([x + middle, y + 500 + 2 * f, seen], -1) for f in range(FRAMES) for middle in (400, 600)]
    capture = write_capture(tmp_path, ring(1), np.reshape(moving, (1, FRAMES, 2, 25, 3)))
    capture = dataclasses.replace(capture, recorded_sizes_px={"c0": (8000, 8000)})
    with pytest.raises(InputError, match=r"at \(4804, 4004\) and \(3204, 4004\) in camera c0, frame 0"):
        subject_keypoints(capture)
    # Its lens scales them by 1 - r^2, with r = 0.1005 and 0.0995 focal lengths from the middle of the image.
    lens = [[8000.0, 0, 3999.5], [0, 8000, 3999.5], [0, 0, 1]], [-1.0, 0, 0, 0]
    with pytest.raises(InputError, match=r"at \(4795, 4003\) and \(3211, 4003\) in camera c0, frame 0"):
        subject_keypoints(dataclasses.replace(capture, recorded_lenses={"c0": lens}))


@pytest.mark.parametrize("chosen", [0, 1])
def test_the_named_person_is_the_subject(chosen: int, tmp_path: Path) -> None:
    """The person may be named by a point on the ground or in an image."""
    cameras = ring(3)
    people_m = staying((0, -0.6)), staying((0, 0.6))
    capture, each = recorded(tmp_path, cameras, *people_m)
    x, y = cameras[1].project(people_m[chosen][7, 1])[0]
    for point in (SubjectPoint((0.1, (-0.5, 0.5)[chosen])), SubjectPoint((x + 3, y + 9), "c1", 7)):
        named = dataclasses.replace(capture, subject_point=point)
        assert share_right(subject_keypoints(named), each[chosen]) == 1


def test_a_subject_point_where_nobody_is_found_is_refused(tmp_path: Path) -> None:
    """In frame 5 both people are elsewhere. One camera alone cannot locate people on the ground."""
    people_m = staying((0, -0.6)), staying((0, 0.6))
    for joints_m in people_m:
        joints_m[5] = 100.0
    capture, _ = recorded(tmp_path, ring(1), *people_m)
    for point, why in (
        (SubjectPoint((0, 0), "c0", 5), "nobody is found there"),
        (SubjectPoint((0, 0)), "one camera tells no places on the ground; name a point in its image"),
    ):
        with pytest.raises(InputError, match=f"capture.toml: subject: {why}"):
            subject_keypoints(dataclasses.replace(capture, subject_point=point))


@pytest.mark.parametrize(("stride", "missed"), [(1, slice(4, 7)), (5, slice(0))])
@pytest.mark.parametrize(("cameras", "surer_in"), [(1, 0), (3, 0), (4, 0), (4, 2)])
def test_a_bystander_is_not_taken_for_the_subject(
    tmp_path: Path, cameras: int, surer_in: int, stride: int, missed: slice
) -> None:
    """The subject moves by 13 % of their height per frame, or by half of it. A bystander is some metres away, or nearer
    and detected with more confidence, but by only two of four cameras. With the smaller moves, the first camera misses
    the subject for three frames. The order of people differs between images."""
    rig, order = ring(cameras), stride * np.arange(12) % 12
    both, expected = {}, {}
    for i, camera in enumerate(rig):
        uv = camera.project(walk_m()[0] + ([1.5, 0.5, 0] if surer_in else [-2.5, 1.6, 0]))[0]
        confidence = 0.95 * (i < surer_in) if surer_in else 0.8
        other = np.broadcast_to(np.concatenate([uv, np.full((25, 1), confidence)], 1), (12, 1, 25, 3))
        subject = detections(rig, noise_px=1)[i, order][:, None]
        if camera.name == "c0":
            subject[missed] = 0
        both[camera.name], expected[camera.name] = np.concatenate([subject, other], 1), subject[:, 0]
        both[camera.name][i::3] = both[camera.name][i::3, ::-1]
    chosen = subject_keypoints(write_capture(tmp_path, rig, np.stack([*both.values()])))
    for name, keypoints in expected.items():
        np.testing.assert_array_equal(chosen[name], keypoints)


def test_one_camera_takes_the_largest_and_most_central_person(tmp_path: Path) -> None:
    camera = ring(4)[0]
    subject = detections([camera], noise_px=1)
    small = subject * [0.4, 0.4, 1]  # towards the upper left corner, at the same confidence
    chosen = subject_keypoints(write_capture(tmp_path, [camera], np.stack([small, subject], 2)))
    np.testing.assert_array_equal(chosen["c0"], subject[0])


def test_test_cameras_are_never_read(tmp_path: Path) -> None:
    cameras = ring(4)
    capture = write_capture(tmp_path, cameras, detections(cameras[:3], 1))
    capture = dataclasses.replace(capture, train_cameras=("c0", "c1", "c2"), test_cameras=("c3",))
    assert set(subject_keypoints(capture)) == {"c0", "c1", "c2"}


def test_a_person_seen_by_only_one_of_several_cameras_is_refused(tmp_path: Path) -> None:
    cameras = ring(3)
    rng = np.random.default_rng(0)
    seen = np.stack([seen_by(c, walk_m(), rng) * (c.name == "c1") for c in cameras])
    with pytest.raises(InputError, match="no person found by any camera but c1"):
        subject_keypoints(write_capture(tmp_path, cameras, seen))


def test_a_nan_keypoint_counts_as_not_seen(tmp_path: Path) -> None:
    capture, (subject,) = recorded(tmp_path, ring(1), walk_m())
    subject["c0"][3, 7, 0] = np.nan
    capture = write_capture(tmp_path, list(capture.cameras.values()), subject["c0"][None])
    found = subject_keypoints(capture)["c0"][3]
    assert found[7].tolist() == [0, 0, 0] and np.array_equal(found[8], subject["c0"][3, 8])


def test_the_error_for_a_camera_without_keypoints_says_how_to_get_them(tmp_path: Path) -> None:
    """The network is not run automatically, since the other camera's keypoints came with the recording."""
    capture, _ = recorded(tmp_path, ring(2), walk_m())
    with edited_keypoints(tmp_path) as kept:
        del kept["c1"]
    with pytest.raises(InputError, match=r"camera c1: no keypoints; set detection\.source=network, or detect some"):
        subject_keypoints(capture)


def test_a_badly_calibrated_camera_keeps_its_detections_of_the_subject(tmp_path: Path) -> None:
    """The third camera is calibrated 30 degrees off, so the others support none of its detections. A stranger walks by
    farther away."""
    cameras = ring(3)
    capture, (subject, _) = recorded(tmp_path, cameras, walk_m(FRAMES), walking((-2.5, 2), (-2.5, -2)))
    wrong = capture.with_cameras(capture.cameras | {"c2": turned(cameras[2], 30)})
    found = subject_keypoints(wrong)
    assert min(share_right({name: found[name]}, {name: subject[name]}) for name in found) > 0.9
