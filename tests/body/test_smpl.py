"""Read SMPL's file format as a rig, tested with a made-up person of tubes whose vertices follow from SMPL's own
equations."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hnerf.body.body_model import body_model
from hnerf.body.fit import fit_body
from hnerf.body.fit_result import BodyFit
from hnerf.body.given_start import initial_pose_from_given
from hnerf.body.rig import pose_vertices
from hnerf.body.smpl import read_smpl
from hnerf.capture.given_poses import GivenPoses
from hnerf.config import FitSettings
from hnerf.errors import InputError
from tests.body.made_up_smpl import LEFT_ELBOW, PARENTS, made_up_smpl, write_smpl
from tests.body.recorded_body import RING, joints_m, record


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_smpl(tmp_path_factory.mktemp("smpl") / "made_up.npz")


def smpl_vertices(theta: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and joints (24, 3), Y up, by SMPL (Loper et al. 2015, eqs. 2-6) without pose blend
    shapes."""
    data = made_up_smpl()
    shaped = data["v_template"] + data["shapedirs"] @ betas
    joints = data["J_regressor"] @ shaped
    world = []
    for j, parent in enumerate((*PARENTS, 20, 21)):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(theta[j]).as_matrix()
        local[:3, 3] = joints[j] - (joints[parent] if j else 0)
        world.append(world[parent] @ local if j else local)
    posed = np.stack(world)
    moved = posed.copy()
    moved[:, :3, 3] -= np.einsum("jab,jb->ja", posed[:, :3, :3], joints)
    blended = np.einsum("vj,jab->vab", data["weights"], moved)
    return np.einsum("vab,vb->va", blended[:, :3, :3], shaped) + blended[:, :3, 3], posed[:, :3, 3]


def random_parameters() -> GivenPoses:
    """Return random poses of two frames without rotations of toes and hands, which are locked."""
    random = np.random.default_rng(0)
    theta = random.normal(0, 0.4, (2, 24, 3))
    theta[:, [10, 11, 22, 23]] = 0
    root = np.tile(np.eye(4), (2, 1, 1))
    root[:, :3, :3], root[:, :3, 3] = Rotation.random(2, rng=1).as_matrix(), [[0.5, 1, 2], [0, 0, 3]]
    return GivenPoses(theta, root, random.normal(0, 1, 10))


def test_the_smpl_rig_has_annys_axes_and_rest_pose(model_file: Path) -> None:
    """Z is up, the body faces -Y with its left at +X, arms hang down and elbows are bent forwards. Weights and
    regressors sum to 1."""
    rig = read_smpl(model_file).rig
    points = (rig.keypoint_weights @ rig.vertices_m).numpy()
    nose, left_wrist, left_elbow, left_shoulder, left_toe, left_heel = (points[k] for k in (0, 7, 6, 5, 19, 21))
    assert nose[1] < -0.1 and left_toe[1] < left_heel[1] - 0.1
    assert left_wrist[0] > left_elbow[0] > left_shoulder[0] > 0.1
    assert left_wrist[2] < left_elbow[2] < left_shoulder[2] - 0.1 and left_wrist[1] < left_elbow[1] - 0.1
    torch.testing.assert_close(rig.skin_weights.sum(1), torch.ones(6890, dtype=torch.float64))
    torch.testing.assert_close(rig.keypoint_weights.sum(1), torch.ones(25, dtype=torch.float64))
    assert int(rig.free.sum()) == 19 and rig.joint_names[LEFT_ELBOW] == "lowerarm01.L" and rig.parents[0] == -1


def test_given_smpl_parameters_reproduce_smpls_joints_and_vertices(model_file: Path) -> None:
    """Joints agree exactly, and so do vertices that follow a single joint and that no pose blend shape moves."""
    model, given = body_model(FitSettings(body_model=model_file)), random_parameters()
    pose = initial_pose_from_given(given, model, (0, 1))
    joints = joints_m(pose).numpy()
    vertices = pose_vertices(pose.rig, pose.theta, pose.root).numpy()
    weights, posedirs = made_up_smpl()["weights"], made_up_smpl()["posedirs"]
    rigid = (weights.max(1) == 1) & ~posedirs.any((1, 2))
    assert rigid.sum() > 5000
    for t in range(2):
        expected, expected_joints = smpl_vertices(given.theta[t], given.betas)
        R, move = given.root[t, :3, :3], given.root[t, :3, 3]
        assert np.allclose(joints[t], expected_joints @ R.T + move, atol=1e-9)
        assert np.allclose(vertices[t][rigid], (expected @ R.T + move)[rigid], atol=1e-9)


def test_the_rest_pose_includes_its_pose_blend_shapes(model_file: Path) -> None:
    """Compared with a model without it, the made-up blend shape lifts the forearm by 0.1 (R - 1)[0, 0], where R is the
    elbow's rotation from the T pose to the rest pose in SMPL's axes."""
    smpl = read_smpl(model_file)
    data = made_up_smpl()
    plain_file = model_file.with_name("plain.npz")
    np.savez(plain_file, **data | {"posedirs": 0 * data["posedirs"]})
    lifted = (smpl.rig.vertices_m - read_smpl(plain_file).rig.vertices_m).norm(dim=1)
    shoulder, elbow = (smpl.rest_rotations[j] for j in (16, 18))
    expected = 0.1 * abs(float((shoulder.T @ elbow)[0, 0]) - 1)  # both frames share the x axis
    assert expected > 0.01
    forearm = data["posedirs"].any((1, 2)) & (data["weights"].max(1) == 1)
    torch.testing.assert_close(lifted[forearm], torch.full((int(forearm.sum()),), expected, dtype=torch.float64))
    assert not lifted[~data["posedirs"].any((1, 2))].any()


def test_pickled_and_plain_files_give_the_same_model(model_file: Path, tmp_path: Path) -> None:
    pickled, plain = read_smpl(write_smpl(tmp_path / "m.pkl")).rig, read_smpl(model_file).rig
    torch.testing.assert_close(pickled.vertices_m, plain.vertices_m)
    torch.testing.assert_close(pickled.shape_basis, plain.shape_basis)


def test_smplx_eyeballs_are_removed(tmp_path: Path) -> None:
    """Each eye is a tube of 190 vertices. Its first ring, of 27, has half of its weight on the head and is kept. The
    eyes' keypoints move to nearby skin."""
    rig = read_smpl(write_smpl(tmp_path / "x.npz", "smplx")).rig
    assert len(rig.vertices_m) == 10475 - 2 * (190 - 27)
    assert int(rig.free.sum()) == 19 and len(rig.joint_names) == 55
    assert set(rig.faces.unique().tolist()) <= set(range(len(rig.vertices_m)))
    eyes = (rig.keypoint_weights @ rig.vertices_m)[[15, 16]]
    expected = torch.tensor([[-0.03, -0.14, 0.44], [0.03, -0.14, 0.44]], dtype=torch.float64)
    assert float((eyes - expected).norm(dim=1).max()) < 0.05


def test_a_fit_to_its_own_keypoints_recovers_pose_and_shape(model_file: Path, tmp_path: Path) -> None:
    rig = read_smpl(model_file).rig.reshaped(torch.tensor([0, 1, -1, 0.5, *[0.0] * 6], dtype=torch.float64))
    theta = torch.zeros(3, 24, 3)
    swings = {"upperarm01.L": (-0.3, -0.5, -0.6), "upperleg01.L": (0.0, 0.2, 0.3), "lowerleg01.R": (0.4, 0.4, 0.5)}
    for name, turns in swings.items():
        theta[:, rig.joint_names.index(name), 0] = torch.tensor(turns)
    root = torch.eye(4).repeat(3, 1, 1)
    root[:, 2, 3] = -rig.vertices_m[:, 2].min()
    truth = BodyFit(rig.to(dtype=torch.float32), (0, 1, 2), theta, root)
    capture = record(tmp_path, truth, RING, tuple(RING))
    fit, report = fit_body(capture, None, FitSettings(body_model=model_file))
    assert float((joints_m(fit) - joints_m(truth)).norm(dim=-1).max()) < 0.02
    assert float((fit.rig.beta - truth.rig.beta).abs()[:4].max()) < 0.4 and max(report["keypoint_residual_px"]) < 1


BAD = {
    "no file": (lambda f: f.unlink(), "no such body model"),
    "not an archive": (lambda f: f.write_bytes(b"nothing"), "not a .npz of plain arrays"),
    "another mesh": (
        lambda f: _rewrite(f, v_template=np.zeros((100, 3))),
        "100 vertices and 24 joints are not those of SMPL",
    ),
    "too few weights": (lambda f: _rewrite(f, weights=np.zeros((6890, 3))), "weights is not that of an SMPL model"),
    "face index out of range": (lambda f: _rewrite(f, f=np.array([[0, 1, 6890]])), "f is not that of an SMPL model"),
    "a child before its parent": (lambda f: _rewrite(f, kintree_table=np.full((2, 24), 23)), "kintree_table is not"),
    "NaN": (lambda f: _rewrite(f, shapedirs=np.full((6890, 3, 10), np.nan)), "shapedirs is not"),
    "scalar template": (lambda f: _rewrite(f, v_template=np.array(3.0)), "0 vertices and 24 joints"),
    "scalar shapes": (lambda f: _rewrite(f, shapedirs=np.array(3.0)), "shapedirs is not"),
    "too few shapes": (lambda f: _rewrite(f, shapedirs=np.zeros((6890, 3, 9))), "shapedirs is not"),
    "1D parents": (lambda f: _rewrite(f, kintree_table=np.arange(24)), "kintree_table is not"),
    "no faces": (lambda f: _rewrite(f, f=np.zeros((0, 3), int)), "f is not"),
    "1D faces": (lambda f: _rewrite(f, f=np.arange(9)), "f is not"),
    "regressor of zeros": (lambda f: _rewrite(f, J_regressor=np.zeros((24, 6890))), "J_regressor is zero"),
    "weights of zeros": (lambda f: _rewrite(f, weights=np.zeros((6890, 24))), "row of weights"),
    "pickled arrays": (lambda f: _rewrite(f, f=np.array([{}], object)), "not a .npz of plain arrays"),
    "no shapes": (lambda f: _rewrite(f, shapedirs=None), "no shapedirs; give an SMPL"),
}


def _rewrite(path: Path, **changed: np.ndarray | None) -> None:
    data = made_up_smpl() | changed
    np.savez(path, **{key: value for key, value in data.items() if value is not None})


def test_huge_integers_in_a_pickle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "m.pkl").write_bytes(pickle.dumps(made_up_smpl() | {"f": [[10**600, 1, 2]]}, 2))
    with pytest.raises(InputError, match=r"m\.pkl: holds other data"):
        read_smpl(tmp_path / "m.pkl")


@pytest.mark.parametrize("case", BAD)
def test_invalid_model_files_are_refused(case: str, tmp_path: Path) -> None:
    damage, names = BAD[case]
    path = tmp_path / "m.npz"
    path.write_bytes(b"")
    damage(path)
    with pytest.raises(InputError, match=names) as refusal:
        body_model(FitSettings(body_model=path))
    assert "m.npz" in str(refusal.value)
