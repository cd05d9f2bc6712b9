"""Writing the performer's capture: EasyMocap's layout, `capture.toml`, and `ground_truth/`."""

import itertools
import json
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hnerf.body.anny import anny_rig
from hnerf.body.descriptor import normals_of
from hnerf.body.rig import Rig, joint_transforms, pose_vertices
from hnerf.capture.capture import write_image
from hnerf.capture.formats.easymocap import write_easymocap
from hnerf.capture.lens import pinhole
from hnerf.config import SyntheticSettings
from hnerf.geometry.camera import Camera, look_at
from hnerf.synthetic.appearance import FACE
from hnerf.synthetic.detect import detect
from hnerf.synthetic.dressed import Dressed, midpoints
from hnerf.synthetic.render import (
    Caster,
    Painted,
    RoomView,
    dome_lights,
    floor_shadow,
    irradiance,
    render_person,
)
from hnerf.synthetic.walk import WalkPose, walk_pose

CAMERA_DISTANCE_M, CAMERA_HEIGHT_M, AIM_HEIGHT_M = 3.0, 1.45, 0.92
HALF_VIEW = 0.40  # tangent of half the field of view: the walking person with a small margin
SENSOR_NOISE = 1.0  # standard deviation, of 255
MESH_EVERY = 4  # frames
WAVING_AFTER_S = 0.3  # how far into the novel poses the arm is up

# Joint names that other tools know, for those joints that are the same place in both rigs.
MIXAMO = {
    "root": "Hips", "neck01": "Neck", "head": "Head",
    **{f"{anny}.{s}": f"{side}{name}" for s, side in (("L", "Left"), ("R", "Right")) for anny, name in (
        ("upperarm01", "Arm"), ("lowerarm01", "ForeArm"), ("wrist", "Hand"),
        ("upperleg01", "UpLeg"), ("lowerleg01", "Leg"), ("foot", "Foot"),
    )},
}  # fmt: skip
BODY_25_NAMES = (
    "Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip", "RHip", "RKnee",
    "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar", "LBigToe", "LSmallToe", "LHeel", "RBigToe",
    "RSmallToe", "RHeel",
)  # fmt: skip


log = logging.getLogger("hnerf.capture")


@dataclass(frozen=True)
class Instant:
    """One frame's truth: the body's keypoints_m (25, 3) and joints_m (J, 3), and the dressed person; world metres.

    shadow: what of the floor's light arrives around ground_m (3,); see `floor_shadow`.
    """

    keypoints_m: np.ndarray
    joints_m: np.ndarray
    person: Painted
    shadow: np.ndarray
    ground_m: np.ndarray


def write_synthetic_capture(out: Path, settings: SyntheticSettings) -> None:
    """Write a capture of a clothed, walking person into `out`; the same bytes for the same settings."""
    rig = anny_rig()
    dressed = Dressed.on(rig, np.random.default_rng(settings.seed))
    test_cameras = camera_names(settings)[1]
    views = {camera.name: RoomView.of(camera) for camera in ring_of_cameras(settings)}
    for name, view in views.items():
        write_image(out / "background" / f"{name}.jpg", _eight_bit(view.plate))
    write_easymocap(out, [pinhole(view.camera) for view in views.values()])
    _write_toml(out, settings)

    instants = []
    for frame in range(settings.train_frames + settings.novel_pose_frames):
        log.info("frame %d of %d", frame + 1, settings.train_frames + settings.novel_pose_frames)
        instant = _instant(dressed, _pose(rig, frame, settings))
        with ThreadPoolExecutor() as pool:
            seeds = ((settings.seed, frame, number) for number in range(len(views)))
            jobs = [
                pool.submit(_write_view, out, frame, view, instant, name in test_cameras, np.random.default_rng(seed))
                for (name, view), seed in zip(views.items(), seeds, strict=True)
            ]
        for job in jobs:
            job.result()
        instants.append(instant)
    _write_truth(out, rig, dressed, instants)


def camera_names(settings: SyntheticSettings) -> tuple[list[str], list[str]]:
    """Training and test cameras, numbered on from 01."""
    names = [f"{number:02d}" for number in range(1, settings.train_cameras + settings.test_cameras + 1)]
    return names[: settings.train_cameras], names[settings.train_cameras :]


def ring_of_cameras(settings: SyntheticSettings) -> list[Camera]:
    """Training cameras at equal angles, then test cameras half-way between, all looking at the middle."""
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


def _pose(rig: Rig, frame: int, settings: SyntheticSettings) -> WalkPose:
    time_s = frame / settings.fps
    waving = np.clip((frame + 1 - settings.train_frames) / settings.fps / WAVING_AFTER_S, 0, 1)
    return walk_pose(rig, time_s, float(waving))


def _instant(dressed: Dressed, pose: WalkPose) -> Instant:
    """Stand the posed person on the floor and light it."""
    root = pose.root.clone()
    root[2, 3] -= float(dressed.posed_m(pose.theta, root, pose.gait_phase)[:, 2].min())
    vertices_m = dressed.posed_m(pose.theta, root, pose.gait_phase)
    lights, caster = dome_lights(), Caster(vertices_m, dressed.faces)
    normals = normals_of(vertices_m, dressed.faces)
    # Shadows are soft: it is enough to look from the body's own vertices, not from all that refinement added.
    body = slice(len(vertices_m) - len(dressed.edges))
    visible = midpoints(caster.visibility(vertices_m[body] + 3e-3 * normals[body], lights[0]), dressed.edges)
    looks = np.hstack([dressed.rest_m, dressed.depths_m, irradiance(normals, visible, lights)[:, None]])
    rig = dressed.rig
    face_m = (rig.keypoint_weights[list(FACE)] @ rig.vertices_m).double().numpy()
    return Instant(
        keypoints_m=(rig.keypoint_weights @ pose_vertices(rig, pose.theta, root)).double().numpy(),
        joints_m=joint_transforms(rig, pose.theta, root)[:, :3, 3].double().numpy(),
        person=Painted(vertices_m, dressed.faces, caster, looks, face_m),
        shadow=floor_shadow(caster, root[:3, 3].numpy(), lights),
        ground_m=root[:3, 3].double().numpy(),
    )


def _write_view(
    out: Path, frame: int, view: RoomView, instant: Instant, scored: bool, rng: np.random.Generator
) -> None:
    """Image, keypoints and ground truth of one camera at one frame; what renders are scored against if it is scored."""
    camera = view.camera
    on_black, coverage, mask = render_person(instant.person, camera)
    photograph = on_black + (1 - coverage[..., None]) * view.shadowed(instant.shadow, instant.ground_m)
    noise = rng.normal(0, SENSOR_NOISE / 255, photograph.shape)
    write_image(out / "images" / camera.name / f"{frame:06d}.jpg", _eight_bit(photograph + noise))
    write_image(
        out / "ground_truth" / "masks" / camera.name / f"{frame:06d}.png", np.where(mask, 255, 0).astype(np.uint8)
    )
    if scored:
        write_image(out / "ground_truth" / "on_black" / camera.name / f"{frame:06d}.jpg", _eight_bit(on_black))
    detected = detect(instant.keypoints_m, camera, instant.person.caster, rng)
    path = out / "openpose" / camera.name / f"{frame:06d}_keypoints.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    person = {"person_id": [-1], "pose_keypoints_2d": detected.round(3).ravel().tolist()}
    path.write_text(json.dumps({"version": 1.3, "people": [person]}))


def _write_toml(out: Path, settings: SyntheticSettings) -> None:
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


def _write_truth(out: Path, rig: Rig, dressed: Dressed, instants: list[Instant]) -> None:
    frames = np.arange(0, len(instants), MESH_EVERY)
    np.savez_compressed(
        out / "ground_truth" / "meshes.npz",
        faces=dressed.faces.astype(np.int32),
        vertices=np.stack([instants[f].person.vertices_m for f in frames]).astype(np.float32),
        frames=frames,
    )
    known = [rig.joint_names.index(name) for name in MIXAMO]
    np.savez_compressed(
        out / "ground_truth" / "joints.npz",
        names=np.array([*BODY_25_NAMES, *(f"rig:{name}" for name in MIXAMO.values())]),
        positions=np.stack([np.concatenate([i.keypoints_m, i.joints_m[known]]) for i in instants]).astype(np.float32),
    )


def _eight_bit(rgb: np.ndarray) -> np.ndarray:
    """From [0, 1]."""
    return (rgb * 255).round().clip(0, 255).astype(np.uint8)
