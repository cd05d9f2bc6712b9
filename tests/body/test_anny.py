from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import anny
import pytest
import torch
import trimesh
from safetensors import SafetensorError

from hnerf.body.anny import ADULT, BETA_NAMES, PHENOTYPES, _coefficients, anny_model, anny_rig, inner_skin
from hnerf.body.descriptor import BodyMeshes
from hnerf.body.rig import pose_vertices
from hnerf.errors import PlaceError


def test_the_average_adult_is_watertight_and_of_plausible_height() -> None:
    rig = anny_rig()
    edges = torch.cat([rig.faces[:, [0, 1]], rig.faces[:, [1, 2]], rig.faces[:, [2, 0]]])
    _, counts = edges.sort(1).values.unique(dim=0, return_counts=True)
    assert (counts == 2).all()
    height_m = float(rig.vertices_m[:, 2].max() - rig.vertices_m[:, 2].min())
    assert 1.6 < height_m < 1.9
    torch.testing.assert_close(rig.skin_weights.sum(1), torch.ones(len(rig.vertices_m)))
    torch.testing.assert_close(rig.keypoint_weights.sum(1), torch.ones(25))


@pytest.mark.parametrize(("folder_mode", "mode"), [(0o755, 0o644), (0o2775, 0o664), (0o700, 0o600)])
def test_who_may_read_the_folder_of_the_prepared_model_may_read_its_files(
    folder_mode: int, mode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Users may share it (ANNY_CACHE_DIR); anny reports a file that it may not read as missing."""

    def prepare(**_: object) -> SimpleNamespace:
        (tmp_path / "v14").mkdir()
        (tmp_path / "v14").chmod(folder_mode)
        (tmp_path / "v14" / "a.safetensors").touch(0o600)
        return SimpleNamespace(phenotype_labels=PHENOTYPES)

    monkeypatch.setattr(anny, "Anny", prepare)
    monkeypatch.setattr("anny.paths._ANNY_CACHE_DIR", [tmp_path])
    anny_model.__wrapped__()
    assert (tmp_path / "v14" / "a.safetensors").stat().st_mode & 0o777 == mode


def test_a_damaged_prepared_model_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is the machine's fault, not the recording's, and no result of a study."""
    monkeypatch.setattr(anny, "Anny", Mock(side_effect=SafetensorError("header too small")))
    monkeypatch.setattr("anny.paths._ANNY_CACHE_DIR", [tmp_path])
    with pytest.raises(PlaceError, match=rf"^{tmp_path}: damaged \(header too small\); delete this folder"):
        anny_model.__wrapped__()


def test_mouth_and_eye_sockets_are_capped() -> None:
    """Closest points on anny's own mesh would be on the linings, which reach several centimetres inwards."""
    rig = anny_rig()
    mesh = trimesh.Trimesh(rig.vertices_m.numpy(), rig.faces.numpy(), process=False)
    assert mesh.is_winding_consistent and mesh.euler_number == 2
    assert not inner_skin()[rig.faces].any()
    lining, only = rig.vertices_m[inner_skin()], torch.zeros(int(inner_skin().sum()), dtype=torch.int32)
    found = BodyMeshes(rig.vertices_m[None], rig.faces).closest_points(lining, only, 1.0, exact_sign=True)
    closest = (rig.vertices_m[rig.faces[found.face]] * found.barycentric[..., None]).sum(1)
    depth_m = -found.sign * (closest - lining).norm(dim=1)
    assert depth_m.max() > 0.02 and depth_m.min() > -0.005


def test_keypoints_lie_where_a_body_25_detector_sees_them() -> None:
    """anny faces -Y with Z up, so its left is at +X: nose in front, ankles below knees, left wrist on the left."""
    rig = anny_rig()
    nose, right_wrist, left_wrist = ((rig.keypoint_weights @ rig.vertices_m)[k] for k in (0, 4, 7))
    left_knee, left_ankle, left_heel = ((rig.keypoint_weights @ rig.vertices_m)[k] for k in (13, 14, 21))
    assert nose[1] < -0.1 and abs(float(nose[0])) < 0.01
    assert left_wrist[0] > 0.3 and right_wrist[0] < -0.3
    assert left_heel[2] < left_ankle[2] < left_knee[2] - 0.3


def test_the_shape_basis_is_the_derivative_of_the_rig() -> None:
    """The basis agrees with central differences of 1e-2, away from the anchors of anny's piecewise shape space."""
    beta = torch.tensor(ADULT) + 0.1
    rig = anny_rig(beta)
    for k in (0, 4, BETA_NAMES.index("measure-upperleg-height"), BETA_NAMES.index("l-foot-scale+r-foot-scale")):
        step = torch.zeros_like(beta)
        step[k] = 0.01
        above, below = anny_rig(beta + step), anny_rig(beta - step)
        torch.testing.assert_close((above.vertices_m - below.vertices_m) / 0.02, rig.shape_basis[k], atol=2e-3, rtol=0)
        torch.testing.assert_close((above.joints_m - below.joints_m) / 0.02, rig.joint_basis[k], atol=2e-3, rtol=0)


@pytest.mark.parametrize("phenotypes", [0.0, 0.37, 0.5, 1.0])
def test_derivatives_of_coefficients_match_autograd(phenotypes: float) -> None:
    """This includes 0 and 1, the ends of the range, and 0.5, an anchor of most phenotypes. Ages below 0 are not
    supported."""
    beta = torch.tensor([phenotypes] * 6 + [0.1] * 22, dtype=torch.float64)
    beta[1] = max(phenotypes, 0.1)
    found = _coefficients(beta)[1:]  # first, since the model cannot be loaded inside a transform
    exact = torch.func.jacfwd(lambda values: _coefficients(values)[0])(beta)
    torch.testing.assert_close(found, exact.T, atol=1e-9, rtol=0)


def test_local_changes_are_linear_with_no_kink_at_zero() -> None:
    step = torch.zeros(len(ADULT))
    step[BETA_NAMES.index("measure-lowerleg-height")] = 0.5
    middle = torch.tensor(ADULT)
    up, at, down = (anny_rig(beta).vertices_m for beta in (middle + step, middle, middle - step))
    torch.testing.assert_close(up - at, at - down, atol=1e-5, rtol=0)
    assert float((up - at).abs().max()) > 0.02


def test_shape_values_are_clamped_to_their_range() -> None:
    assert torch.equal(anny_rig(torch.full((28,), 2.0)).beta, torch.ones(28))
    assert anny_rig(torch.full((28,), -2.0)).beta.tolist() == [0.0] * 6 + [-1.0] * 22


def test_a_bent_elbow_brings_the_hand_to_the_shoulder_without_moving_the_rest() -> None:
    rig = anny_rig()
    theta = torch.zeros(104, 3)
    elbow, wrist = rig.joint_names.index("lowerarm01.L"), rig.joint_names.index("wrist.L")
    upper = rig.joints_m[elbow] - rig.joints_m[rig.joint_names.index("upperarm01.L")]
    lower = rig.joints_m[wrist] - rig.joints_m[elbow]
    axis = torch.linalg.cross(upper, lower)
    theta[elbow] = 1.5 * axis / axis.norm()
    moved = (pose_vertices(rig, theta, torch.eye(4)) - rig.vertices_m).norm(dim=1)
    hand = (rig.skin_joints == wrist).any(1) & (
        rig.skin_weights.argmax(1) == (rig.skin_joints == wrist).int().argmax(1)
    )
    assert float(moved[hand].min()) > 0.2
    assert float(moved[rig.vertices_m[:, 0] < 0].max()) < 1e-5
