"""Scores of a synthetic training, whose models are grey balls of known colours."""

import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hnerf.avatar.avatar import Rendering
from hnerf.avatar.finished import reason_without_novel_poses
from hnerf.capture.capture import Capture, read_rgb
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.evaluation.images import render
from hnerf.evaluation.metrics import mask_box
from hnerf.evaluation.views import View
from hnerf.study.benchmark import scoring
from hnerf.study.benchmark.plan import ScoringSettings
from hnerf.study.benchmark.scoring import ScoringScene, frame_seconds, score, score_end, score_views, write_pictures
from tests.evaluation.ball import (
    PHOTOGRAPHED,
    RADIUS_M,
    BallAvatar,
    ball_camera,
    ball_fit,
    ball_mask,
    centre_m,
    coarse_surfaces,
    tuned,
    write_ball_capture,
    write_ball_truth,
    write_settings,
)
from tests.full_disk import files_up_to

GAP_M = 0.01  # between the ball and its true surface
GREYS = {
    "training": 102,
    "5": 51,
    "10": 76.5,
    "12": 0,
    "14": 0,
}  # of 255: the end, and snapshots
SETTINGS = ScoringSettings(meshes=1, snapshot_images=2, snapshot_meshes=0, frame_sizes_px=(16, 32))


@dataclass(frozen=True)
class SizedBall(BallAvatar):
    """A ball that records the size of every rendering."""

    sizes: list[tuple[int, int]] = field(default_factory=list)

    def render(self, camera: Any, theta: torch.Tensor, root: torch.Tensor) -> Rendering:
        self.sizes.append(camera.size_px)
        return super().render(camera, theta, root)


def scored(
    base: Path, test_cameras: tuple[str, ...], settings: ScoringSettings = SETTINGS, kind: str = "fast"
) -> dict[str, Any]:
    """Score, into `base`/out, a training of 15 s whose field took 12 s, with snapshots up to the field's end and one of
    later, when only poses of novel frames change."""
    training = base / "training"
    stored = {"static": False, "training": {"field": {"kind": kind}, "pose_learning_rate": 0}}
    for name, seconds in {
        "5": 6.5,
        "10": 10.0,
        "12": 12.0,
        "14": 14.0,
    }.items():  # the first was taken late, after a long step
        folder = training / "snapshots" / name
        folder.mkdir(parents=True)
        (folder / "settings.json").write_text(json.dumps(stored | {"seconds": seconds}))
    write_settings(training, kind)
    report = {"seconds": 15.0, "field_seconds": 12.0, "peak_memory_gib": 1.5, "model_mib": 7.0}
    (training / "report.json").write_text(json.dumps(report))
    capture = write_ball_capture(base / "capture", test_cameras)
    write_ball_truth(capture, RADIUS_M + GAP_M)
    out = base / "out"
    out.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scoring, "load_avatar", lambda path: BallAvatar(tuned(ball_fit()), GREYS[path.name]))
        coarse_surfaces(patch)
        return score(scene(capture), training, settings, out)


def scene(capture: Capture) -> ScoringScene:
    """Return the scene that the ball is scored against."""
    return ScoringScene(capture, ball_fit(), GroundTruth(capture.root, capture))


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a capture with one test camera and its scores."""
    folder = tmp_path_factory.mktemp("scored")
    scored(folder, ("c",))
    return folder


@pytest.fixture
def found(base: Path) -> dict[str, Any]:
    """Return the scores of `base`."""
    read: dict[str, Any] = json.loads((base / "out" / "scores.json").read_text())
    return read


def psnr_db(grey: float, camera: str, frame: int) -> float:
    """Return the PSNR of a ball of this grey level: only its own pixels are wrong, all by the same amount."""
    mask = ball_mask(ball_camera(camera, {"a": 0.0, "c": 160.0}[camera]), centre_m(frame))
    return -10 * np.log10(mask[mask_box(mask)].mean() * ((PHOTOGRAPHED - round(grey)) / 255) ** 2)


def test_the_curve_has_snapshots_at_their_true_times_and_the_end_of_the_field(found: dict[str, Any]) -> None:
    assert [row["seconds"] for row in found["curve"]] == [6.5, 10.0, 12.0]
    assert found["split"] == "novel_view"
    for row, grey in zip(found["curve"], (51, 76.5, 102), strict=True):
        assert row["n"] == 2
        assert row["psnr"] == pytest.approx(np.mean([psnr_db(grey, "c", f) for f in (0, 2)]), abs=1e-3)
        assert row["geometry_reason"] == "the study requests no surface here"
    assert found["novel_view"]["psnr"] == pytest.approx(np.mean([psnr_db(102, "c", f) for f in (0, 1, 2)]), abs=1e-3)
    assert found["novel_view"]["geometry"]["chamfer_mm"] == pytest.approx(1e3 * GAP_M, rel=0.02)
    assert found["training"]["model_mib"] == 7.0


def test_only_the_end_of_a_longer_training_is_scored(base: Path, found: dict[str, Any], tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path / "capture")
    write_ball_truth(capture, RADIUS_M + GAP_M)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scoring, "load_avatar", lambda path: BallAvatar(tuned(ball_fit()), GREYS[path.name]))
        end = score_end(scene(capture), base / "training", SETTINGS, tmp_path)
    assert end == {"training": found["training"], "curve": found["curve"][-1:]}
    assert json.loads((tmp_path / "scores.json").read_text()) == end


def test_curves_of_new_poses_are_animated_and_end_with_the_field(tmp_path: Path) -> None:
    """Curves are scored without fitting poses to the finished field. Training raised the novel frame's body by two
    pixels."""
    found = scored(tmp_path, ("c",), SETTINGS.model_copy(update={"split": "novel_pose"}))
    assert [row["seconds"] for row in found["curve"]] == [6.5, 10.0, 12.0]
    for row, grey in zip(found["curve"], (51, 76.5, 102), strict=True):
        assert row["psnr"] == pytest.approx(psnr_db(grey, "c", 3), abs=1e-3)
    assert found["novel_pose"]["psnr"] == pytest.approx(psnr_db(102, "c", 3), abs=1e-3)
    assert found["novel_pose"]["mask_iou"] == 1.0
    for column in ("posed", "tracked"):  # one image here, as no frame has parameters of its own
        assert found[f"novel_pose_{column}"]["mask_iou"] < 0.9
        (row,), (animated,) = found[f"novel_pose_{column}"]["per_image"], found["novel_pose"]["per_image"]
        assert row["view_angle_deg"] == animated["view_angle_deg"]  # measured on the body that all methods share
        assert "geometry" not in found[f"novel_pose_{column}"]


def test_without_a_test_camera_nothing_is_scored_on_images(tmp_path: Path) -> None:
    found = scored(tmp_path, ())
    assert found["curve"] == [] and found["pictures"] == []
    assert found["novel_view"]["psnr"] is None
    assert found["novel_view"]["reason"] == "the capture has no test cameras"
    assert found["novel_pose"]["psnr"] is None and "evaluation.holdout" in found["novel_pose"]["reason"]
    assert found["novel_view"]["geometry"]["n"] == 1
    assert not (tmp_path / "out" / "renders").exists()


def test_scores_of_images_include_their_distance_from_training(found: dict[str, Any]) -> None:
    rows = found["novel_view"]["per_image"]
    assert [row["frame"] for row in rows] == [0, 1, 2]
    assert rows[0]["view_angle_deg"] == pytest.approx(80.0, abs=1e-3)  # cameras at 0, 80 and 160 degrees
    assert [row["pose_distance_deg"] for row in rows] == [0.0, 0.0, 0.0]
    (surface,) = found["novel_view"]["geometry"]["per_surface"]
    assert surface["pose_distance_deg"] == 0.0


def test_truth_and_rendering_are_written_for_each_chosen_image(base: Path, found: dict[str, Any]) -> None:
    assert found["pictures"] == [{"camera": "c", "frame": 0}, {"camera": "c", "frame": 2}]
    written = {path.name: read_rgb(path) for path in (base / "out" / "pictures").iterdir()}
    middles = {name: int(picture[picture.shape[0] // 2, picture.shape[1] // 2, 0]) for name, picture in written.items()}
    assert middles == {f"{k}-{name}.png": grey for k in (0, 1) for name, grey in (("render", 102), ("truth", 153))}


def test_an_image_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path)
    write_ball_truth(capture)
    render({"novel_view": BallAvatar(ball_fit())}, capture, [View("novel_view", "c", 1)], tmp_path)
    shown = [{"camera": "c", "frame": 1}]
    with files_up_to(100), pytest.raises(OSError, match=r"File too large: .*0-render\.png"):
        write_pictures(scene(capture), "novel_view", shown, tmp_path)


def test_a_method_without_poses_has_a_reason_instead_of_scores(tmp_path: Path) -> None:
    found = scored(tmp_path, ("c",), SETTINGS.model_copy(update={"split": "novel_pose"}), "nerf")
    assert found["novel_pose"]["psnr"] is None and found["novel_pose"]["geometry"] is None
    assert found["novel_pose"]["reason"] == "NeRF models one moment"
    assert found["curve"] == []
    assert found["novel_view"]["n"] == 3


def test_which_methods_have_no_novel_poses(tmp_path: Path) -> None:
    def reason(kind: str, static: bool) -> str | None:
        stored = {"static": static, "training": {"field": {"kind": kind}, "pose_learning_rate": 0}}
        (tmp_path / "settings.json").write_text(json.dumps(stored))
        return reason_without_novel_poses(tmp_path)

    assert [reason(name, False) for name in ("fast", "paper", "neural_body")] == [None] * 3
    assert reason("fast", True) is None
    assert re.match("H-NeRF's static network", reason("paper", True) or "")
    assert re.match("Nerfies has no pose", reason("nerfies", False) or "")


def test_only_images_with_ground_truth_are_chosen(tmp_path: Path) -> None:
    """One of three frames is to be scored, but only the middle one has a mask."""
    capture = write_ball_capture(tmp_path)
    write_ball_truth(capture, masked=(1,))
    found = score_views(scene(capture), BallAvatar(ball_fit()), "novel_view", 1, 0, tmp_path)
    assert [row["frame"] for row in found["per_image"]] == [1]


def test_the_size_of_a_timed_frame_is_its_longer_side() -> None:
    avatar = SizedBall(ball_fit())
    wide = replace(ball_camera("a", 0.0), width_px=64, height_px=32)
    assert frame_seconds(avatar, wide, 0, 16) > 0
    assert avatar.sizes == [(16, 8)] * 3


def test_the_time_of_a_frame_is_the_median_of_renderings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three renderings take 1, 9 and 2 s."""
    clock = iter((0.0, 1.0, 10.0, 19.0, 20.0, 22.0))
    monkeypatch.setattr(scoring.time, "perf_counter", lambda: next(clock))
    assert frame_seconds(BallAvatar(ball_fit()), ball_camera("a", 0.0), 0, 16) == 2.0
