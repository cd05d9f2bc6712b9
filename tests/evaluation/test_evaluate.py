"""The whole evaluation on a synthetic subject with known scores, and against the independent scoring program."""

import dataclasses
import html
import json
import re
import runpy
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh

from hnerf.capture.capture import Capture
from hnerf.config import EvaluationSettings
from hnerf.evaluation import evaluate as module
from hnerf.evaluation.evaluate import PROTOCOL, evaluate, mesh_frames, protocol_of, reason_without_surface
from hnerf.evaluation.geometry import score_geometry
from hnerf.evaluation.ground_truth import GIVEN_MASKED_IMAGE, MASKED_IMAGE, UNDER_GIVEN_MASKS, truth_of
from hnerf.evaluation.images import render
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.evaluation.metrics import mask_box
from hnerf.evaluation.views import View
from tests.evaluation.ball import (
    PHOTOGRAPHED,
    RADIUS_M,
    RENDERED,
    TUNED_M,
    BallAvatar,
    ball_camera,
    ball_fit,
    ball_inputs,
    ball_mask,
    centre_m,
    coarse_surfaces,
    tuned,
    write_ball_capture,
    write_ball_masks,
    write_ball_truth,
    write_settings,
)

SCORE_RUN = Path(__file__).parents[2].parent / "shared" / "accept" / "score_run.py"
GAP_M = 0.01
Scored = tuple[Path, dict[str, Any]]
TEST_CAMERA = ball_camera("c", 160.0)
HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module", autouse=True)
def coarse_meshes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        coarse_surfaces(patched)
        yield


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Scored:
    """Evaluate a subject with ground truth and one test camera; write the evaluation next to its capture."""
    base = tmp_path_factory.mktemp("scored")
    capture = write_ball_capture(base / "capture")
    write_ball_truth(capture, RADIUS_M + GAP_M)
    inputs = ball_inputs(dataclasses.replace(capture, notes=("cameras from the person",)))
    avatar = BallAvatar(tuned(inputs.fitted), PHOTOGRAPHED, PHOTOGRAPHED - RENDERED)
    inputs = dataclasses.replace(inputs, avatar=avatar)
    history = [{"step": k, "seconds": 2.0 * k, "losses": {"rec": 0.1}, "held_out": {"psnr": 20.0 + k}} for k in (0, 1)]
    (inputs.training_folder / "history.jsonl").write_text("\n".join(map(json.dumps, history)))
    (inputs.training_folder / "report.json").write_text(json.dumps({"device": "a processor", "seconds": 12.5}))
    cameras = {"a": {"status": "ok", "median_px": 0.5}, "b": {"status": "rejected", "median_px": 9.25}}
    findings = {"cameras": cameras, "notes": [HOSTILE], "doubts": ["left and right are exchanged"]}
    (inputs.calibration_folder / "report.json").write_text(json.dumps(findings))
    (inputs.fit_folder / "report.json").write_text(json.dumps({"doubts": ["limbs have no depth"]}))
    out = base / "subject" / "evaluation"
    out.mkdir(parents=True)
    return base, evaluate(inputs, EvaluationSettings(max_meshes=1, report_rows=2), out)


@pytest.fixture(scope="module")
def unscored(tmp_path_factory: pytest.TempPathFactory) -> Scored:
    """Evaluate a subject without ground truth or test cameras, whose name contains markup."""
    base = tmp_path_factory.mktemp("unscored")
    return evaluated(ball_inputs(write_ball_capture(base / "capture", (), HOSTILE)))


def test_image_scores_by_hand(scored: Scored) -> None:
    base, found = scored
    psnr = []
    for frame in (0, 1, 2):
        mask = ball_mask(TEST_CAMERA, centre_m(frame))
        error = mask[mask_box(mask)].mean() * ((PHOTOGRAPHED - RENDERED) / 255) ** 2
        psnr.append(-10 * np.log10(error))
    assert found["novel_view"]["psnr"] == pytest.approx(np.mean(psnr), abs=1e-4)
    assert found["novel_view"]["mask_iou"] == 1.0
    columns = ("novel_pose", "novel_pose_posed", "novel_pose_tracked")
    assert [found[split]["n"] for split in ("novel_view", *columns)] == [3, 1, 1, 1]
    assert found["novel_view"]["reference"] == "image x ground-truth mask"
    assert found == json.loads((base / "subject" / "evaluation" / "metrics.json").read_text())


def test_the_report_may_show_more_images_than_are_scored(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path / "capture")
    write_ball_truth(capture, None)  # surfaces are scored elsewhere
    out, found = evaluated(ball_inputs(capture), max_images=1, report_rows=3)
    assert found["novel_view"]["n"] == 1 and (out / "report.html").is_file()


def test_scored_images_are_chosen_among_those_with_a_true_mask(tmp_path: Path) -> None:
    """Of frames 0 to 2, only frame 1 has a mask, so it is chosen instead of the first and the last."""
    capture = write_ball_capture(tmp_path / "capture")
    write_ball_truth(capture, None, masked=(1,))
    _, found = unreported(capture, max_images=2)
    assert [row["frame"] for row in found["novel_view"]["per_image"]] == [1]


def test_geometry_scores_by_hand(scored: Scored) -> None:
    geometry = scored[1]["novel_view"]["geometry"]
    assert geometry["chamfer_mm"] == pytest.approx(1e3 * GAP_M, rel=0.01)
    assert geometry["chamfer_l2_e3"] == pytest.approx(1e3 * GAP_M**2, rel=0.02)
    assert geometry["iou"] == pytest.approx((RADIUS_M / (RADIUS_M + GAP_M)) ** 3, abs=0.005)
    assert geometry["normal_consistency"] > 0.999
    assert geometry["watertight"] == 1 and geometry["n"] == 1
    assert [row["frame"] for row in geometry["per_surface"]] == [0]
    assert scored[1]["novel_pose"]["geometry"] is None  # no true surface in its frame


def test_renderings_and_meshes_have_the_documented_paths(scored: Scored) -> None:
    out = scored[0] / "subject" / "evaluation"
    written = {str(p.relative_to(out)) for p in out.rglob("*") if p.suffix in (".png", ".ply") and p.parent != out}
    assert {p for p in written if "training_view" not in p} == {
        *(f"renders/novel_view/c/{f:06d}.png" for f in (0, 1, 2)),
        *(f"renders/novel_pose{column}/c/000003.png" for column in ("", "_posed", "_tracked")),
        "meshes/000000.ply",
        "meshes/000003.ply",
    }
    image = cv2.imread(str(out / "renders/novel_view/c/000001.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.shape == (64, 64, 4) and image.dtype == np.uint8
    assert np.array_equal(image[..., 0], ball_mask(TEST_CAMERA, centre_m(1)) * RENDERED)
    assert np.array_equal(image[..., 3], ball_mask(TEST_CAMERA, centre_m(1)) * 255)


def test_scores_agree_with_the_independent_scoring_program(scored: Scored) -> None:
    if not SCORE_RUN.exists():
        pytest.skip("the independent scoring program is not beside this checkout")
    (base, found), program = scored, runpy.run_path(str(SCORE_RUN))
    for split, frames in (("novel_view", (0, 1, 2)), ("novel_pose", (3,))):
        theirs = program["images"](base / "subject", base / "capture", split, ["c"], frames)
        for name in ("n", "psnr", "ssim", "mask_iou"):
            assert found[split][name] == pytest.approx(theirs[name], rel=1e-6), (split, name)
    predicted = trimesh.load_mesh(base / "subject" / "evaluation" / "meshes" / "000000.ply", process=False)
    stored = np.load(base / "capture" / "ground_truth" / "meshes.npz")
    truth = trimesh.Trimesh(stored["vertices"][0], stored["faces"], process=False)
    ours = score_geometry(predicted, truth, np.random.default_rng(0), samples=5000, nodes=40)
    theirs = program["geometry"](predicted, truth, np.random.default_rng(0), n=5000, grid=40)
    for name in ("chamfer_l2_e3", "chamfer_mm", "normal_consistency", "iou", "watertight"):
        assert ours[name] == pytest.approx(theirs[name], rel=1e-6), name


def test_a_rendering_that_cannot_be_written_raises_an_error(tmp_path: Path) -> None:
    """A folder exists at the path of a rendering."""
    view = View("novel_view", "c", 1)
    view.path(tmp_path).mkdir(parents=True)
    with pytest.raises(OSError, match=r"Is a directory: .*000001\.png"):
        render({"novel_view": BallAvatar(ball_fit())}, write_ball_capture(tmp_path / "capture"), [view], tmp_path)


def test_without_ground_truth_scores_are_null_with_a_reason(unscored: Scored) -> None:
    _, found = unscored
    assert found["novel_view"]["psnr"] is None and "no test cameras" in found["novel_view"]["reason"]
    assert found["novel_pose"]["psnr"] is None and "no test camera" in found["novel_pose"]["reason"]
    assert found["novel_pose"]["geometry"] is None
    assert "no ground-truth surface" in found["novel_pose"]["geometry_reason"]
    assert reason_without_surface(found["novel_pose"]) is None  # there is one, but nothing to compare it with


def test_without_test_cameras_training_images_are_not_novel_views(unscored: Scored) -> None:
    renders = unscored[0] / "renders"
    columns = ["novel_pose", "novel_pose_posed", "novel_pose_tracked"]
    assert sorted(p.name for p in renders.iterdir()) == [*columns, "training_view"]
    assert sorted(p.parent.name for p in (renders / "novel_pose").rglob("*.png")) == ["a", "b"]


def test_novel_poses_are_rendered_as_fitted_tuned_and_tracked(scored: Scored) -> None:
    """As fitted, the score is perfect, because without per-frame changes the ball has the photograph's grey and the fit
    is true. Tuned poses are two pixels too high, and tracked ones are darker as well."""
    out, found = scored[0] / "subject" / "evaluation", scored[1]
    true = ball_mask(TEST_CAMERA, centre_m(3))
    lifted = ball_mask(TEST_CAMERA, centre_m(3) + np.array([0, 0, TUNED_M]))
    for split, place, grey in (
        ("novel_pose", true, PHOTOGRAPHED),
        ("novel_pose_posed", lifted, PHOTOGRAPHED),
        ("novel_pose_tracked", lifted, RENDERED),
    ):
        image = cv2.imread(str(out / "renders" / split / "c" / "000003.png"), cv2.IMREAD_UNCHANGED)
        assert image is not None and np.array_equal(image[..., 0], place * grey), split
        error = (place * grey / 255.0 - true * PHOTOGRAPHED / 255.0)[mask_box(true)]
        assert found[split]["psnr"] == pytest.approx(-10 * np.log10((error**2).mean() + 1e-10), abs=1e-4)
        assert found[split]["mask_iou"] == pytest.approx((place & true).sum() / (place | true).sum())
    assert found["novel_pose"]["psnr"] == 100.0 and found["novel_pose_posed"]["mask_iou"] < 0.9
    mesh = trimesh.load_mesh(out / "meshes" / "000003.ply", process=False)
    assert mesh.bounds.mean(0) == pytest.approx(centre_m(3), abs=1e-3)


def test_the_report_shows_all_three_novel_pose_columns_side_by_side(scored: Scored) -> None:
    text = (scored[0] / "subject" / "evaluation" / "report.html").read_text()
    for column in ("", "_posed", "_tracked"):
        assert f"{scored[1][f'novel_pose{column}']['psnr']:.2f}" in text
    assert 'alt="Posed"' in text and 'alt="Tracked"' in text
    assert "not trained on, in poses as fitted before training" in text


def evaluated(inputs: EvaluationInputs, **settings: Any) -> Scored:
    """Evaluate a ball; return the output folder, next to its capture, and the metrics."""
    out = inputs.capture_folder.with_name("evaluation")
    out.mkdir()
    return out, evaluate(inputs, EvaluationSettings(**{"max_meshes": 1, "report_rows": 1} | settings), out)


def unreported(capture: Capture, kind: str = "fast", **settings: Any) -> Scored:
    """Evaluate a ball trained with a kind of field, without writing a report."""
    inputs = ball_inputs(capture)
    write_settings(inputs.training_folder, kind)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "write_report", lambda *_: None)
        return evaluated(inputs, **settings)


class Mist(BallAvatar):
    """A ball whose field has no surface."""

    def signed_distance(self, points_m: torch.Tensor, theta: torch.Tensor, root: torch.Tensor) -> torch.Tensor:
        return torch.full((len(points_m),), 0.05)


def test_a_field_without_a_surface_is_scored_on_images_and_gives_a_reason(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path / "capture")
    write_ball_truth(capture)
    inputs = ball_inputs(capture)
    out, _ = evaluated(dataclasses.replace(inputs, avatar=Mist(inputs.fitted)))
    found = json.loads((out / "metrics.json").read_text())
    reason = "no surface in its box (everything is outside)"
    for split in ("novel_view", "novel_pose"):
        assert found[split]["n"] > 0 and found[split]["geometry"] is None
        assert reason in found[split]["geometry_reason"] and reason in (reason_without_surface(found[split]) or "")
    assert reason in (out / "report.html").read_text()


def test_a_method_without_tuning_has_one_novel_pose_column(tmp_path: Path) -> None:
    out, found = unreported(write_ball_capture(tmp_path / "capture"), "neural_body")
    assert found["novel_pose_posed"]["reason"] == "no pose of these frames was tuned"
    assert found["novel_pose_tracked"]["reason"] == "these frames have no deformation of their own"
    assert sorted(p.name for p in (out / "renders").iterdir()) == ["novel_pose", "novel_view", "training_view"]
    for split in ("novel_view", "novel_pose"):  # test cameras without ground truth
        assert "neither ground-truth masks nor" in found[split]["reason"]


def test_test_cameras_without_truth_are_scored_with_the_recordings_masks(tmp_path: Path) -> None:
    """Of two test cameras only c has masks, which lack the left half of the ball. Scores follow from that, for a
    uniform rendering."""
    capture = write_ball_capture(tmp_path / "capture", ("c", "d"))
    write_ball_masks(capture, "c")
    out, found = evaluated(ball_inputs(capture))
    whole = ball_mask(TEST_CAMERA, centre_m(3))
    half = whole & (np.arange(whole.shape[1]) >= whole.shape[1] // 2)
    error = (whole * RENDERED / 255 - half * PHOTOGRAPHED / 255)[mask_box(half)]
    assert found["novel_pose"]["psnr"] == pytest.approx(-10 * np.log10((error**2).mean()), abs=1e-4)
    assert found["novel_pose"]["mask_iou"] == pytest.approx(half.sum() / whole.sum())
    assert [row["camera"] for row in found["novel_view"]["per_image"]] == ["c"] * 3
    assert found["novel_view"]["without_mask"] == 3
    assert found["novel_view"]["reference"] == "photograph x given mask"
    assert "no ground-truth surface" in found["novel_view"]["geometry_reason"]
    assert found["protocol"] == f"{PROTOCOL} Here, images are compared to {UNDER_GIVEN_MASKS}."
    text = html.unescape((out / "report.html").read_text())
    assert text.count(f"New poses, tracked: compared to {UNDER_GIVEN_MASKS}") == 2  # below the figures and in the notes
    assert 'alt="Ground truth"' not in text and text.count('alt="Input × mask"') > 1  # not only for the training view


def test_true_masks_take_precedence_over_the_recordings_masks(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path)
    write_ball_masks(capture, "c")
    write_ball_truth(capture)
    truth = truth_of(tmp_path, capture)
    assert truth.on_black("c", 0)[1] == MASKED_IMAGE and protocol_of(truth) == PROTOCOL
    shutil.rmtree(tmp_path / "ground_truth" / "masks" / "c")  # masks of training cameras stay
    truth = truth_of(tmp_path, capture)
    assert truth.on_black("c", 0)[1] == GIVEN_MASKED_IMAGE and list(truth.meshes()) == [0]


def test_masks_of_training_cameras_are_not_used_for_scores(tmp_path: Path) -> None:
    capture = write_ball_capture(tmp_path)
    write_ball_masks(capture, "a")
    assert not truth_of(tmp_path, capture).has_masks


def test_a_method_without_poses_renders_no_novel_poses(tmp_path: Path) -> None:
    out, found = unreported(write_ball_capture(tmp_path / "capture"), "nerfies")
    assert "Nerfies has no pose to set" in found["novel_pose"]["reason"]
    assert "Nerfies has no pose to set" in found["novel_pose"]["geometry_reason"]
    assert sorted(p.name for p in (out / "renders").iterdir()) == ["novel_view", "training_view"]
    assert [p.stem for p in (out / "meshes").iterdir()] == ["000000"]


def test_pixels_of_training_cameras_are_never_scored(tmp_path: Path) -> None:
    """This holds although every image has ground truth."""
    capture = write_ball_capture(tmp_path / "capture", ())
    write_ball_truth(capture)
    out, found = unreported(capture)
    for split in ("novel_view", "novel_pose", "novel_pose_posed", "novel_pose_tracked"):
        assert (found[split]["n"], found[split]["psnr"], found[split]["per_image"]) == (0, None, [])
    assert "evaluation.holdout" in found["novel_pose"]["reason"]
    assert found["holdout"] is None and "evaluation.holdout=each" in found["holdout_reason"]
    rendered = sorted((out / "renders" / "novel_pose").rglob("*.png"))
    assert [p.parent.name for p in rendered] == ["a", "b"]  # rendered for inspection only
    assert len(list((out / "renders" / "novel_pose_tracked").rglob("*.png"))) == 1  # only the one in the report
    assert found["novel_view"]["geometry"]["n"] == 1  # geometry needs no pixels


class _Page(HTMLParser):
    """Parse a page: headings, links, and everything that a browser would load or run."""

    def __init__(self, text: str):
        super().__init__()
        self.headings: list[str] = []
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.tags: set[str] = set()
        self._in_heading = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self._in_heading = tag == "h2"
        found = [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "poster")]
        (self.links if tag == "a" else self.loaded).extend(found)

    def handle_data(self, data: str) -> None:
        if self._in_heading:
            self.headings.append(data)
            self._in_heading = False


def test_the_report_has_every_section_and_loads_nothing(scored: Scored) -> None:
    text = (scored[0] / "subject" / "evaluation" / "report.html").read_text()
    page = _Page(text)
    galleries = ["Training views", "New views", "New poses", "Surface"]
    assert page.headings == ["Summary", *galleries, "Asset", "Training", "Findings", "Cost", "Notes"]
    assert all(address.startswith("data:image/") for address in page.loaded)
    outside = [address for address in page.links if not address.startswith("#")]
    assert outside == ["../asset/viewer.html", "../asset/report.html"]  # from subjects/<name>/evaluation
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert "://" not in text and "@import" not in text and not re.search(r"url\(", text)


def test_the_report_shows_scores_findings_and_charts(scored: Scored) -> None:
    base, found = scored
    text = (base / "subject" / "evaluation" / "report.html").read_text()
    assert f"{found['novel_view']['psnr']:.2f}" in text
    assert ">3 images, 1 surface<" in text
    assert '<span class="status rejected">' in text and "9.25" in text
    for doubt in ("cameras from the person", "left and right are exchanged", "limbs have no depth"):
        assert doubt in text.partition("<nav>")[0]  # doubts are at the top
    assert "a processor" in text and "12.5" in text
    assert 'alt="Losses"' in text and 'alt="Held-out quality"' in text
    lpips = found["novel_view"]["lpips"]
    assert ("LPIPS is not available" if lpips is None else f"{lpips:.3f}") in text
    views, surfaces = ("Input", "Mask", "Fitted body", "Render", "Ground truth", "Error"), ("Surface", "Distance")
    for caption in (*views, *(f"{s}, {side}" for s in surfaces for side in ("front", "back"))):
        assert f'alt="{caption}"' in text, caption


def test_the_report_escapes_text_from_captures(scored: Scored, unscored: Scored) -> None:
    assert "&lt;script&gt;alert(1)" in (unscored[0] / "report.html").read_text()
    assert "&lt;script&gt;alert(1)" in (scored[0] / "subject" / "evaluation" / "report.html").read_text()
    assert "script" not in _Page((unscored[0] / "report.html").read_text()).tags


def test_the_report_says_if_there_is_no_ground_truth(unscored: Scored) -> None:
    text = (unscored[0] / "report.html").read_text()
    assert "the capture has no test camera" in text and "the report shows training views instead" in text
    assert 'alt="Ground truth"' not in text and 'alt="Input × mask"' in text
    assert "No history was recorded" in text


def test_mesh_frames_are_spread_over_frames_with_a_true_surface() -> None:
    truths = dict.fromkeys((0, 4, 8, 12, 16, 20), trimesh.Trimesh())
    assert mesh_frames(tuple(range(24)), truths, 4) == [0, 8, 12, 20]
    assert mesh_frames(tuple(range(24)), {}, 3) == [0, 12, 23]
    assert mesh_frames((1, 2), truths, 4) == [1, 2]
