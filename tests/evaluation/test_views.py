from pathlib import Path

from hnerf.evaluation.views import TRAINING_VIEW, View, all_views, sample_views
from hnerf.evenly_spaced import evenly_spaced
from tests.evaluation.ball import write_ball_capture


def test_splits_with_test_cameras(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path, ("c", "d"))
    assert all_views(capture, "novel_view") == [View("novel_view", c, f) for c in ("c", "d") for f in (0, 1, 2)]
    for column in ("novel_pose", "novel_pose_posed", "novel_pose_tracked"):
        assert all_views(capture, column) == [View(column, "c", 3), View(column, "d", 3)]


def test_splits_without_test_cameras(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path, ())
    assert all_views(capture, "novel_view") == []
    assert all_views(capture, "novel_pose") == [View("novel_pose", "a", 3), View("novel_pose", "b", 3)]


def test_sampled_views_alternate_between_cameras(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path)
    shown = sample_views(all_views(capture, TRAINING_VIEW), 3)
    assert [(v.camera, v.frame) for v in shown] == [("a", 0), ("b", 1), ("a", 2)]


def test_a_single_frame_is_sampled_from_several_cameras(tmp_path: Path) -> None:
    """The ball's only novel frame is seen by three test cameras."""
    capture = write_ball_capture(tmp_path, ("c", "d", "e"))
    poses, views = all_views(capture, "novel_pose"), all_views(capture, "novel_view")
    assert [v.camera for v in sample_views(poses, 3)] == ["c", "d", "e"]
    assert [v.camera for v in sample_views(poses, 2)] == ["c", "e"]
    assert [(v.camera, v.frame) for v in sample_views(views, 3)] == [("c", 0), ("d", 1), ("e", 2)]
    assert sample_views([], 3) == []


def test_sampled_views_are_spread_over_frames() -> None:
    """Camera c has frames 1 and 2, camera d has 0 and 1. At the second of three frames it is the second camera's
    turn."""
    views = [View("novel_view", c, f) for c, f in (("c", 1), ("c", 2), ("d", 0), ("d", 1))]
    assert [(v.camera, v.frame) for v in sample_views(views, 3)] == [("d", 0), ("d", 1), ("c", 2)]


def test_evenly_spaced_items_include_both_ends() -> None:
    assert evenly_spaced(range(10), 4) == [0, 3, 6, 9]
    assert evenly_spaced((5, 7), 4) == [5, 7]
