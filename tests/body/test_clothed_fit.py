"""Cloth offsets worked out by hand: on one triangle, on a ball's outline, and on a body that they pull sideways."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body.articulation import Pose
from hnerf.body.clothed_fit import _with_more_cloth, match_clothed, refine_with_clothing, solve_cloth_offset
from hnerf.body.contour_fit import ContourResiduals, Outline, outline
from hnerf.body.descriptor import normals_of
from hnerf.body.keypoint_fit import Problem
from hnerf.config import FitSettings
from hnerf.geometry.silhouette import silhouette
from tests.body.recorded_body import RING, joints_m, moving_body, problem_at, record, true_pose
from tests.body.test_contour_fit import SCALE_M, SEEN_PX, disc, matched


def test_cloth_offsets_are_smooth_between_neighbours() -> None:
    """One corner of a triangle is 1 cm too small. There, (1 + 0.02 + 2 x 2) a - 2 b - 2 b = 0.01; at the two others,
    (0.02 + 2 x 2) b - 2 a - 2 b = 0. So b = a / 1.01 and a = 0.01 / (5.02 - 4 / 1.01)."""
    rows = ContourResiduals(np.array([0]), np.zeros((1, 3)), np.array([-0.01]), np.ones(1))
    a = 0.01 / (5.02 - 4 / 1.01)
    np.testing.assert_allclose(solve_cloth_offset(np.zeros(3), [rows], np.array([[0, 1, 2]])), [a, a / 1.01, a / 1.01])


def test_an_edge_shared_by_two_faces_counts_once() -> None:
    """Two triangles share the edge 1-2; vertex 1 is 1 cm too small. At 1, (1.02 + 6) a - 4 c - 2 b = 0.01; at 2, 6.02 b
    - 2 a - 4 c = 0; at 0 and 3, 4.02 c - 2 a - 2 b = 0."""
    rows = ContourResiduals(np.array([1]), np.zeros((1, 3)), np.array([-0.01]), np.ones(1))
    found = solve_cloth_offset(np.zeros(4), [rows], np.array([[0, 1, 2], [2, 1, 3]]))
    a, b, c = np.linalg.solve([[7.02, -2, -4], [-2, 6.02, -4], [-2, -2, 4.02]], [0.01, 0, 0])
    np.testing.assert_allclose(found, [c, a, b, c])


def test_adding_cloth_shifts_residuals_and_reweights_them() -> None:
    """Where the body is 1 cm too small, 3 cm more cloth makes it 2 cm too large, with a weight of 1 / (1 + 1)^2. At the
    other vertex nothing changes."""
    rows = ContourResiduals(np.array([2, 0]), np.zeros((2, 3)), np.array([-0.01, 0.0]), np.full(2, 9.0))
    found = _with_more_cloth(rows, np.array([0, 0.5, 0.03]))
    np.testing.assert_allclose(found.residual_m, [0.02, 0])
    np.testing.assert_allclose(found.weight, [0.25, 1])


def test_many_matches_outweigh_the_smoothness_prior() -> None:
    """With an offset of 2 cm, a thousand matches 1 cm outside of it, in two images, give 3 cm; inside, they give 1
    cm."""
    for residual_m, worn_m in ((-0.01, 0.03), (0.01, 0.01)):
        rows = ContourResiduals(
            np.repeat([0, 1, 2], 500), np.zeros((1500, 3)), np.full(1500, residual_m), np.ones(1500)
        )
        found = solve_cloth_offset(np.full(3, 0.02), [rows, rows], np.array([[0, 1, 2]]))
        np.testing.assert_allclose(found, worn_m, rtol=1e-4)


@pytest.mark.parametrize("grow_px", [2, -2])
def test_outlines_pull_inwards_and_outwards(grow_px: int) -> None:
    """A ball 2 px too small or too large has residuals of 2 px, with weights 1 / (1 + (residual / 2 cm)^2)^2. If it is
    too large, they are smaller, since rim vertices lie up to 2.5 px inside its silhouette."""
    edge = outline(disc(SEEN_PX + grow_px), 1.0)
    rows, outwards = matched(edge, match_clothed)
    assert len(rows.vertices) > 0.9 * len(edge.points_px)
    assert np.median(rows.residual_m) == pytest.approx(-grow_px * SCALE_M, abs=SCALE_M)
    np.testing.assert_allclose(rows.weight, (1 + (rows.residual_m / 0.02) ** 2) ** -2)
    assert ((rows.gradient * outwards).sum(1) > 0.9).all()


def test_distant_outlines_are_not_matched() -> None:
    """5 px of 1.07 cm each are more than the limit of 4 cm."""
    assert len(matched(outline(disc(SEEN_PX + 5), 1.0), match_clothed)[0].vertices) == 0


def test_outlines_with_opposite_normals_are_not_matched() -> None:
    edge = outline(disc(SEEN_PX), 1.0)
    assert len(matched(replace(edge, normals=-edge.normals), match_clothed)[0].vertices) == 0


def clothed_scene(folder: Path, frames: int, cameras: int) -> tuple[Problem, Pose, list[list[Outline | None]]]:
    """Return a fit problem with true keypoints, the true pose, and outlines of a body with 2 cm of cloth on its
    front."""
    truth, names = moving_body(tuple(range(frames))), tuple(str(k) for k in range(cameras))
    pose = true_pose(truth)
    problem = problem_at(pose, record(folder, truth, {name: RING[name] for name in names}, names), 300.0, 1)
    faces = truth.rig.faces.numpy()
    edges: list[list[Outline | None]] = []
    front = (normals_of(truth.rig.vertices_m.numpy(), faces)[:, 1] < 0)[:, None]
    for row, vertices_m in enumerate(truth.vertices_m().numpy()):
        worn_m = vertices_m + 0.02 * front * normals_of(vertices_m, faces)
        spacing_px = FitSettings().spacing_m / problem.scale_m[:, row].numpy()
        masks = [silhouette(camera, worn_m, faces) for camera in problem.observations.cameras]
        edges.append([outline(mask, px) for mask, px in zip(masks, spacing_px, strict=True)])
    return problem, pose, edges


def test_clothes_common_to_all_frames_hardly_displace_the_body(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In three steps, joints move by 7 mm; they would move by 16 mm if the body were taken to be naked."""
    monkeypatch.setattr("hnerf.body.clothed_fit.CLOTHED_STEPS", 3)
    problem, pose, edges = clothed_scene(tmp_path, 8, 4)
    found = refine_with_clothing(problem, pose, edges, threads=1)
    assert 0.005 < (joints_m(found) - joints_m(pose))[:, pose.rig.free].norm(dim=-1).mean() < 0.012


@pytest.mark.parametrize(("frames", "cameras"), [(8, 1), (7, 2)])
def test_clothes_are_not_estimated_from_one_camera_or_few_frames(tmp_path: Path, frames: int, cameras: int) -> None:
    problem, pose, edges = clothed_scene(tmp_path, frames, cameras)
    assert refine_with_clothing(problem, pose, edges, threads=1) is pose


def test_fitting_frames_in_parallel_gives_the_same_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hnerf.body.clothed_fit.CLOTHED_STEPS", 1)
    scene = clothed_scene(tmp_path, 8, 2)
    found, same = (refine_with_clothing(*scene, threads) for threads in (1, 2))
    assert torch.equal(found.theta, same.theta) and torch.equal(found.root, same.root)
