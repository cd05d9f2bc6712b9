"""The synthetic capture: its ground truth is consistent, and its clothes go beyond the body model."""

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from pydantic import ValidationError

from hnerf.body.anny import anny_rig
from hnerf.capture.capture import Capture
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings, SyntheticSettings
from hnerf.geometry.rays import cast, mesh_on_cpu
from hnerf.synthetic import write_synthetic_capture
from hnerf.synthetic.dressed import DressedBody
from hnerf.synthetic.render import RoomView, dome_lights, floor_shadow, irradiance, visibility
from hnerf.synthetic.walk import walk_pose
from hnerf.synthetic.write import camera_names, ring_of_cameras

TINY = SyntheticSettings(size_px=64, train_frames=1, novel_pose_frames=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("performer") / "performer"
    write_synthetic_capture(path, TINY)
    return path


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    return ingest(folder, CaptureSettings(), folder.parent / "ingested")


def test_the_synthetic_capture_is_ingested_like_any_other(capture: Capture) -> None:
    assert capture.train_cameras == ("01", "02", "03", "04") and capture.test_cameras == ("05", "06")
    assert capture.train_frames == (0,) and capture.novel_pose_frames == (1,)
    assert capture.image("06", 1).shape == (64, 64, 3) and capture.background("03") is not None


def test_the_same_seed_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    write_synthetic_capture(tmp_path, SyntheticSettings(size_px=64, train_frames=1, novel_pose_frames=0))
    for name in ("images/05/000000.jpg", "openpose/02/000000_keypoints.json", "ground_truth/masks/01/000000.png"):
        digests = [hashlib.sha256((root / name).read_bytes()).hexdigest() for root in (folder, tmp_path)]
        assert digests[0] == digests[1]


def test_the_ring_of_cameras_by_hand() -> None:
    """32 cameras are 11.25 degrees apart; each of 16 test cameras stands half-way, in every second gap."""

    def angles_deg(**settings: int) -> list[float]:
        centres = [camera.centre_m for camera in ring_of_cameras(SyntheticSettings(**settings))]
        return [float(np.degrees(np.arctan2(y, x)) % 360) for x, y, _ in centres]

    assert angles_deg() == pytest.approx([0, 90, 180, 270, 45, 225])
    many = angles_deg(train_cameras=32, test_cameras=16)
    assert many[:3] == pytest.approx([0, 11.25, 22.5]) and many[32:35] == pytest.approx([5.625, 28.125, 50.625])
    assert len(many) == 48
    assert camera_names(SyntheticSettings(train_cameras=3, test_cameras=1)) == (["01", "02", "03"], ["04"])
    with pytest.raises(ValidationError, match="one at most between two training cameras"):
        SyntheticSettings(train_cameras=1)


def test_a_ray_parallel_to_two_walls_meets_the_wall_ahead() -> None:
    """The first camera, at (3, 0, 1.45), looks at (0, 0, 0.92); an odd number of pixels has a middle. From there, the
    wall at x = -4.2 is 7.2 m ahead, and the ray falls by 0.53 m in 3 m."""
    middle_m = RoomView.of(ring_of_cameras(SyntheticSettings(size_px=17))[0]).room_m[8, 8]
    np.testing.assert_allclose(middle_m, [-4.2, 0, 1.45 - 7.2 * 0.53 / 3], atol=1e-9)


def test_joints_lie_inside_the_masks(folder: Path, capture: Capture) -> None:
    with np.load(folder / "ground_truth" / "joints.npz", allow_pickle=False) as truth:
        names, positions = [str(n) for n in truth["names"]], truth["positions"]
    scored = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
    assert {f"rig:{side}{limb}" for side in ("Left", "Right") for limb in scored} <= set(names)
    limbs = [i for i, n in enumerate(names) if n.startswith("rig:") and n.endswith(("Arm", "Leg", "Hips", "Neck"))]
    for camera in capture.cameras.values():
        for frame in capture.frames:
            mask = cv2.imread(str(folder / "ground_truth" / "masks" / camera.name / f"{frame:06d}.png"), 0) > 127
            x, y = camera.project(positions[frame, limbs])[0].round().astype(int).T
            assert mask[y, x].all()


def test_image_is_person_over_plate(folder: Path, capture: Capture) -> None:
    """Inside the mask the photograph shows the person; far outside, and off the shadowed floor, the plate."""
    mask = cv2.imread(str(folder / "ground_truth" / "masks" / "05" / "000001.png"), 0) > 127
    alone = cv2.imread(str(folder / "ground_truth" / "on_black" / "05" / "000001.jpg"))[..., ::-1].astype(float)
    image, plate = capture.image("05", 1).astype(float), capture.background("05")
    assert plate is not None
    core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3))) > 0
    far = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7))) == 0
    far[32:] = False  # the upper half shows only walls
    assert core.sum() > 100 and far.sum() > 1000
    assert np.abs(image - alone)[core].mean() < 4 and np.abs(image - plate)[far].mean() < 3
    assert alone[far].max() < 12 and np.abs(image - plate)[core].mean() > 20


def test_keypoints_are_noisy_but_right(folder: Path, capture: Capture) -> None:
    """1.5 px at 256 is 0.375 px at 64; a normal error in two dimensions has its median at 1.18 sigma."""
    with np.load(folder / "ground_truth" / "joints.npz", allow_pickle=False) as truth:
        exact_m = truth["positions"][:, :25]
    errors_px = []
    for camera in capture.cameras.values():
        keypoints = capture.keypoints(camera.name)
        assert keypoints is not None and keypoints.shape == (2, 1, 25, 3)
        seen = keypoints[:, 0, :, 2] > 0.5
        errors_px.append(np.linalg.norm(keypoints[:, 0, :, :2] - camera.project(exact_m)[0], axis=-1)[seen])
    assert 0.9 * 0.375 < np.median(np.concatenate(errors_px)) < 1.5 * 0.375
    confidences = np.concatenate([capture.keypoints(c)[..., 2].ravel() for c in capture.cameras])  # type: ignore[index]
    assert 0.05 < (confidences < 0.5).mean() < 0.6


def test_meshes_are_closed_and_stand_on_the_floor(folder: Path) -> None:
    with np.load(folder / "ground_truth" / "meshes.npz", allow_pickle=False) as truth:
        faces, vertices_m, frames = truth["faces"], truth["vertices"], truth["frames"]
    mesh = trimesh.Trimesh(vertices_m[0], faces, process=False)
    assert frames.tolist() == [0] and mesh.is_watertight and mesh.volume > 0.05
    assert vertices_m[0, :, 2].min() == pytest.approx(0, abs=1e-5) and 1.6 < vertices_m[0, :, 2].max() < 2.0


def test_clothes_stand_off_the_body() -> None:
    """Shirt, trousers and hair stand centimetres off the skin, hands and face do not; folds move with the gait."""
    rig = anny_rig()
    dressed = DressedBody.dress(rig, np.random.default_rng(0))
    rest = torch.zeros(len(rig.joint_names), 3), torch.eye(4)
    clothed_m = [dressed.posed_m(*rest, gait_phase=phase) for phase in (0.0, 1.5)]
    away_m = np.linalg.norm(clothed_m[0] - dressed.rest_m, axis=1)
    depth_m, deepest = dressed.depths_m, dressed.depths_m.argmax(1)
    for garment, least_m in ((1, 0.02), (2, 0.012), (4, 0.015)):
        assert np.median(away_m[deepest == garment]) > least_m
    bare = depth_m[:, 1:].max(1) < -0.01
    assert bare.sum() > 5000 and away_m[bare].max() < 1e-5
    moved_m = np.linalg.norm(clothed_m[1] - clothed_m[0], axis=1)
    assert moved_m[deepest == 1].max() > 0.01 and moved_m[bare].max() == 0


def test_the_performer_walks_where_it_faces() -> None:
    """80 degrees a second on a circle of 20 cm are 28 cm a second."""
    before, after = (walk_pose(anny_rig(), time_s, 0.0).root for time_s in (0.7, 0.701))
    velocity_mps = (after[:3, 3] - before[:3, 3]) / 0.001
    facing = -before[:3, 1]
    torch.testing.assert_close(velocity_mps, 0.279 * facing, atol=2e-3, rtol=0)


def test_rays_meet_a_known_square() -> None:
    """The square z = 1, |x|, |y| <= 1 has two triangles."""
    vertices_m = np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    mesh = mesh_on_cpu(vertices_m, np.array([[0, 1, 2], [0, 2, 3]]))
    hits = cast(mesh, np.array([0.5, -0.25, 3.0]), np.array([[0.0, 0, -1], [0, 0, 1]]))
    assert hits.face.tolist() == [0, -1] and hits.distance_m[0] == pytest.approx(2.0)
    met_m = hits.interpolate(vertices_m, np.array([[0, 1, 2], [0, 2, 3]]))
    assert met_m[0].tolist() == pytest.approx([0.5, -0.25, 1.0])
    visible = visibility(mesh, np.array([[0.0, 0, 0], [0, 0, 2]]), np.array([[0.0, 0, 1]]))
    assert visible.tolist() == [[0.0], [1.0]]


def test_irradiance_and_floor_shadow_under_an_open_sky() -> None:
    lights = dome_lights()
    up, down = np.array([[0.0, 0, 1], [0, 0, -1]])
    bright = irradiance(np.stack([up, down]), np.ones((2, len(lights[1]))), lights)
    assert bright[0] == pytest.approx(1.25) and 0 < bright[1] < 0.3
    roof = mesh_on_cpu(np.array([[-9.0, -9, 1], [9, -9, 1], [0, 9, 1]]), np.array([[0, 1, 2]]))
    assert floor_shadow(roof, np.zeros(3), lights).min() < 0.2
    nothing = mesh_on_cpu(np.array([[0.0, 0, -5], [1, 0, -5], [0, 1, -5]]), np.array([[0, 1, 2]]))
    assert floor_shadow(nothing, np.zeros(3), lights).min() == pytest.approx(1.0)
