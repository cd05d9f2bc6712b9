"""Conversion of every keypoint set to BODY_25: point i of a set lies at (i, 100 i) with confidence 0.5 + i / 1000."""

import json
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.ingest import ingest
from hnerf.capture.keypoint_files import pad_hands, pad_people, read_openpose, read_results
from hnerf.capture.keypoint_sets import SETS, KeypointSetName, hands_of, is_body_25, to_body_25
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture import recordings as rec


def points(count: int) -> np.ndarray:
    """Return the points of a set, (count, 3)."""
    i = np.arange(float(count))
    return np.stack([i, 100 * i, 0.5 + i / 1000], -1)


def converted(count: int, named: KeypointSetName | None = None) -> np.ndarray:
    """Return BODY_25 keypoints (25, 3) of one person in one frame."""
    return to_body_25({"01": points(count)[None, None]}, named)["01"][0, 0]


# x of BODY_25's nose, neck, right arm, left arm, mid-hip, right leg, left leg, eyes and ears (right first).
COCO_BODY = [0, 5.5, 6, 8, 10, 5, 7, 9, 11.5, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3]
FEET: dict[KeypointSetName, list[float]] = {  # left big toe, small toe, heel, then the right
    "coco_17": [0] * 6,
    "body_25b": [19, 20, 21, 22, 23, 24],
    "halpe_26": [20, 22, 24, 21, 23, 25],
    "coco_wholebody": [17, 18, 19, 20, 21, 22],
    "halpe_136": [20, 22, 24, 21, 23, 25],
}


@pytest.mark.parametrize("name", FEET)
def test_sets_that_begin_with_coco_are_converted(name: KeypointSetName) -> None:
    found = converted(SETS[name].points, name)
    assert found[:, 0].tolist() == COCO_BODY + FEET[name]
    assert found[:, 1].tolist() == pytest.approx([100 * x for x in COCO_BODY + FEET[name]])
    feet = [0.5 + x / 1000 if x else 0 for x in FEET[name]]  # a foot point that the set lacks has no confidence
    lower = [0.5 + int(x) / 1000 for x in COCO_BODY]  # a mean has the lower of its two confidences
    assert found[:, 2].tolist() == pytest.approx(lower + feet)


def test_openpose_coco_and_body_25_are_converted() -> None:
    assert converted(18)[:, 0].tolist() == [*range(8), 9.5, *range(8, 18)] + [0] * 6
    assert np.array_equal(converted(25, "body_25"), points(25))


@pytest.mark.parametrize("count", [17, 18, 26, 133, 136])
def test_the_number_of_points_identifies_the_set(count: int) -> None:
    (name,) = (name for name, known in SETS.items() if known.points == count)
    assert np.array_equal(converted(count), converted(count, name))


@pytest.mark.parametrize(("count", "left", "right"), [(133, 91, 112), (136, 94, 115)])
def test_whole_body_sets_have_hands(count: int, left: int, right: int) -> None:
    """COCO-WholeBody's last points are the left hand, 91 to 111, and the right; Halpe's, 94 to 114, and the right."""
    hands = hands_of(points(count)[None, None])
    assert hands is not None and hands.shape == (1, 1, 2, 21, 3)
    assert hands[0, 0, :, [0, 20], 0].tolist() == [[left, right], [left + 20, right + 20]]
    unseen = points(count)
    unseen[left:, 2] = 0
    assert hands_of(unseen[None, None]) is None and hands_of(points(26)[None, None]) is None


@pytest.mark.parametrize("count", [17, 18, 25, 26, 133])
def test_hands_that_a_file_adds_do_not_change_the_body(count: int) -> None:
    with_hands = np.concatenate([points(count), 7 + points(42)])
    assert np.array_equal(to_body_25({"01": with_hands[None, None]}, None)["01"][0, 0], converted(count))
    hands = hands_of(with_hands[None, None])
    assert hands is not None and hands[0, 0, :, 0, 0].tolist() == [7, 28]


def person(face: slice, others: slice) -> np.ndarray:
    """Return keypoints (25, 3) of a person whose points `face` span 1 px, and whose points `others` are 3 px apart."""
    keypoints = np.ones((25, 3))
    keypoints[face, 0], keypoints[others, 0] = [5, 6, 5, 6], [0, 3, 6, 9]
    return keypoints


def test_sets_of_25_points_are_told_apart_by_which_points_are_the_face() -> None:
    body_25, body_25b = person(slice(15, 19), slice(1, 5)), person(slice(1, 5), slice(15, 19))
    assert is_body_25(body_25) and not is_body_25(body_25b)
    assert is_body_25(np.zeros((25, 3)))  # nobody is seen: the more common of the two
    one_ear = np.zeros((25, 3))
    one_ear[4] = body_25b[4]
    assert is_body_25(one_ear)  # a single point has no extent
    assert not is_body_25(np.stack([body_25b, body_25b, body_25]))
    body_25b[[11, 12], :2] = [[4, 5], [6, 5]]
    seen_by_one = {"01": body_25b[None, None], "02": np.zeros((1, 1, 25, 3))}
    assert to_body_25(seen_by_one, None)["01"][0, 0, 8].tolist() == [5, 5, 1]


def test_a_person_seen_from_above_is_recognised_as_body_25() -> None:
    """From above, hidden hips are guessed: the mid-hip lies off their middle by a third of the distance to the nose."""
    body_25 = person(slice(15, 19), slice(1, 5))
    body_25[[0, 8, 9, 12], :2] = [[5, 1], [5, 6], [3, 4], [7, 4]]
    assert is_body_25(body_25)


def test_a_mean_needs_both_points() -> None:
    one_shoulder = points(17)
    one_shoulder[6] = 0
    found = to_body_25({"01": one_shoulder[None, None]}, None)["01"][0, 0]
    assert found[1].tolist() == [0, 0, 0] and found[5, 0] == 5


def test_a_camera_that_sees_nobody_gets_zero_confidence() -> None:
    found = to_body_25({"01": points(17)[None, None], "02": np.zeros((1, 1, 0, 3))}, "coco_17")
    assert found["02"].shape == (1, 1, 25, 3) and not found["02"].any()


def test_a_named_set_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match=r'keypoints = "halpe_26" has 26 points, but camera 01 has 17'):
        converted(17, "halpe_26")


def test_an_unknown_number_of_points_names_the_known_sets(tmp_path: Path) -> None:
    rec.write_keypoints(tmp_path / "a.json", [points(19)])
    with pytest.raises(InputError, match=r"a\.json: 19 keypoints a person; .* coco_17 \(17\), .* halpe_26 \(26\)"):
        read_openpose(tmp_path / "a.json")


def test_people_without_points_are_left_out(tmp_path: Path) -> None:
    people = [{}, {"pose_keypoints_2d": []}, {"pose_keypoints_2d": points(25).ravel().tolist()}]
    for count, kept in ((3, (1, 25, 3)), (2, (0, 0, 3))):
        (tmp_path / "a.json").write_text(json.dumps({"people": people[:count]}))
        assert read_openpose(tmp_path / "a.json").shape == kept


def test_hands_are_read_after_their_persons_points(tmp_path: Path) -> None:
    """OpenPose writes empty lists if it did not look for hands; here, the first person has a left hand alone."""
    path, left = tmp_path / "a.json", points(21) / [1, 100, 1]
    rec.write_keypoints(path, [points(25), points(25)], [(left, []), ([], [])])
    found = read_openpose(path)
    assert found.shape == (2, 67, 3) and np.array_equal(found[:, :25], [points(25)] * 2)
    assert np.array_equal(found[0, 25:46], left) and not found[0, 46:].any() and not found[1, 25:].any()
    rec.write_keypoints(path, [points(25)], [([], [])])
    assert read_openpose(path).shape == (1, 25, 3)
    assert [p.shape[1] for p in pad_hands([found, read_openpose(path), np.zeros((0, 0, 3))])] == [67, 67, 0]
    assert np.array_equal(pad_hands([found, read_openpose(path)])[1][0, :25], points(25))


@pytest.mark.parametrize(
    ("hands", "message"),
    [
        ((points(20), points(20)), "a hand has 21 points"),
        ((points(20), points(22)), "not triples of numbers"),
        ((points(21) * np.nan, []), "NaN"),
    ],
)
def test_hands_that_are_no_hands_are_refused(tmp_path: Path, hands: tuple, message: str) -> None:
    rec.write_keypoints(tmp_path / "a.json", [points(25)], [hands])
    with pytest.raises(InputError, match=rf"a\.json: .*{message}"):
        read_openpose(tmp_path / "a.json")


def test_recorded_hands_are_ingested_like_keypoints(tmp_path: Path) -> None:
    """Camera 01 has hands in all frames but the first, 02 has none. If images shrink from 24 x 16 to 16 x 11 px, x
    becomes 2 x / 3 - 1 / 6, and y becomes 11 y / 16 - 5 / 32."""
    folder = rec.write_easymocap(tmp_path / "person")
    for frame in rec.FRAMES[1:]:
        hands = (np.tile([4.0 + frame, 6, 0.75], (21, 1)), np.tile([20.0, 10, 0.25], (21, 1)))
        person = np.tile([3.0 + frame, 5, 0.5], (25, 1))
        rec.write_keypoints(folder / "openpose" / "01" / f"{frame:06d}_keypoints.json", [person], [hands])
    whole = ingest(folder, CaptureSettings(), tmp_path / "whole")
    small = ingest(folder, CaptureSettings(max_side_px=16), tmp_path / "small")
    given, shrunk = whole.given_hands("01"), small.given_hands("01")
    assert whole.has_given_hands and whole.given_hands("02") is None
    assert given is not None and given.shape == (5, 1, 2, 21, 3) and not given[0].any()
    assert given[3, 0, :, 20].tolist() == [[7, 6, 0.75], [20, 10, 0.25]]
    assert shrunk is not None
    assert shrunk[3, 0, 0, 20].tolist() == pytest.approx([7 * 2 / 3 - 1 / 6, 6 * 11 / 16 - 5 / 32, 0.75])
    keypoints = whole.keypoints("01")
    assert keypoints is not None and keypoints[:, 0, 3].tolist() == [[3 + frame, 5, 0.5] for frame in rec.FRAMES]


def test_a_recording_without_hands_has_no_file_of_hands(tmp_path: Path) -> None:
    assert not ingest(rec.write_easymocap(tmp_path / "person"), CaptureSettings(), tmp_path / "out").has_given_hands


def test_points_that_were_not_seen_may_have_any_position(tmp_path: Path) -> None:
    """The mean of two shoulders at 1e308, one of them without confidence, would be infinite."""
    found = points(17)
    found[5:7, :2], found[5, 2] = 1e308, 0
    (tmp_path / "a.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": found.ravel().tolist()}]}))
    with pytest.raises(InputError, match=r"a\.json: a keypoint is beyond 1e\+06 px; detect them again"):
        read_openpose(tmp_path / "a.json")
    found[6, 2] = 0
    (tmp_path / "a.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": found.ravel().tolist()}]}))
    found[5:7] = 0
    assert np.array_equal(read_openpose(tmp_path / "a.json")[0], found)


def test_all_frames_are_padded_to_the_largest_number_of_people() -> None:
    rows = pad_people([np.zeros((0, 25, 3)), np.ones((2, 25, 3))])
    assert rows.shape == (2, 2, 25, 3) and rows[0].max() == 0 and rows[1].min() == 1
    assert pad_people([np.zeros((0, 25, 3))]).shape == (1, 1, 25, 3)


def test_lists_of_results_are_read_by_frame(tmp_path: Path) -> None:
    """Results are as AlphaPose (image names) and COCO's tools (numbers) write them; scores over 1 count as 1."""
    sure = points(17)
    sure[:, 2] = 3
    results = [
        {"image_id": "000000000002.jpg", "category_id": 1, "keypoints": points(17).ravel().tolist(), "score": 2.9},
        {"image_id": 4, "category_id": 1, "keypoints": points(17).ravel().tolist(), "score": 1.0},
        {"image_id": 4, "category_id": 1, "keypoints": sure.ravel().tolist(), "score": 0.5},
    ]
    (tmp_path / "01.json").write_text(json.dumps(results))
    two, three, four = read_results(tmp_path / "01.json", (2, 3, 4))
    assert np.allclose(two, points(17)[None]) and len(three) == 0
    assert four.shape == (2, 17, 3) and (four[1, :, 2] == 1).all()
    with pytest.raises(InputError, match=r"01\.json: image_id 4 is none of the recording's frames 1 to 3"):
        read_results(tmp_path / "01.json", (1, 2, 3))
    (tmp_path / "01.json").write_text(json.dumps([{}] * 129))
    with pytest.raises(InputError, match=r"01\.json: 129 people in 2 images; keep at most 64 in each"):
        read_results(tmp_path / "01.json", (0, 1))
    for name in ("cover", "walk_1234567890.png", -3, 1.5, True):  # a number of ten digits is no frame
        (tmp_path / "01.json").write_text(json.dumps([{"image_id": name, "keypoints": []}]))
        with pytest.raises(InputError, match=r"01\.json: no list of image_id"):
            read_results(tmp_path / "01.json", (0, 1, 3))


def test_predictions_of_mmpose_are_read(tmp_path: Path) -> None:
    """Nobody is in the first picture. Its demos count that as 1, its inferencer as 0."""
    person = {"keypoints": points(17)[:, :2].tolist(), "keypoint_scores": points(17)[:, 2].tolist(), "bbox": [[0] * 4]}
    for first in (0, 1):
        seen = [{"frame_id": first, "instances": []}, {"frame_id": first + 1, "instances": [person]}]
        written = {"meta_info": {}, "instance_info": seen} if first else seen
        (tmp_path / "01.json").write_text(json.dumps(written))
        nobody, one = read_results(tmp_path / "01.json", (0, 1))
        assert len(nobody) == 0 and np.allclose(one, points(17)[None])
    for wrong in ({}, {"instances": 3}, {"frame_id": "1", "instances": [person]},
                  {"frame_id": 1, "instances": [person | {"keypoint_scores": []}]}):  # fmt: skip
        (tmp_path / "01.json").write_text(json.dumps({"instance_info": [{"frame_id": 1, "instances": []}, wrong]}))
        with pytest.raises(InputError, match=r"01\.json: no list of image_id"):
            read_results(tmp_path / "01.json", (0, 1))


def test_lists_of_results_may_grow_with_the_recording(tmp_path: Path) -> None:
    """A minute of 136 points, at 60 frames a second, has 28 MB."""
    result = {"image_id": 2, "keypoints": points(17).ravel().tolist()}
    (tmp_path / "01.json").write_text(json.dumps([result]) + 28_000_000 * " ")
    assert len(read_results(tmp_path / "01.json", range(3600))[2]) == 1
    with pytest.raises(InputError, match=r"01\.json: 28\d* bytes are too many"):
        read_results(tmp_path / "01.json", range(36))


def test_lists_of_results_next_to_the_images_are_ingested(tmp_path: Path) -> None:
    folder = rec.write_easymocap(tmp_path / "person")
    for path in folder.glob("openpose/*/*.json"):
        path.unlink()
    (folder / "keypoints").mkdir()
    (folder / "capture.toml").write_text('keypoints = "halpe_26"\n')
    for camera in rec.CAMERAS:
        triples = (points(26) / [2, 200, 1]).ravel().tolist()
        text = json.dumps([{"image_id": f, "keypoints": triples, "score": 1} for f in (0, 2)])
        (folder / "keypoints" / f"{camera}.json").write_text(text)
    keypoints = ingest(folder, CaptureSettings(), tmp_path / "out").keypoints("02")
    assert keypoints is not None and keypoints.shape == (3, 1, 25, 3)
    assert keypoints[2, 0, 24].tolist() == pytest.approx([12.5, 12.5, 0.525])
    assert not keypoints[1].any()
