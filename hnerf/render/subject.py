"""Render a trained subject: camera path, poses, body shape and the kinds of image to write."""

import dataclasses
import itertools
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from hnerf.avatar.finished import (
    avatar_of,
    readable,
    reason_without_novel_poses,
    recording_of,
    require_files,
    require_poses,
)
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import pose_vertices
from hnerf.capture.capture import Capture
from hnerf.errors import InputError
from hnerf.files import atomic_folder
from hnerf.geometry.camera import Camera
from hnerf.progress import tracked
from hnerf.render.motion import (
    T_POSE,
    Motion,
    interpolate_poses,
    read_motion,
    retarget,
    select_frames,
    select_poses,
    t_pose_motion,
)
from hnerf.render.pictures import Shot, write_pictures
from hnerf.render.shape import transfer_poses, with_shape_values, with_volume
from hnerf.render.trajectory import interpolate_cameras, orbit, read_camera_path

OUTPUT_KINDS = ("colour", "depth", "normals", "mask", "mesh")
ORBIT_PICTURES = 60  # if there is one pose only
MIN_SIZE_PX, MAX_SIZE_PX = 2, 8000  # square videos of either size can be read back


@dataclass(frozen=True)
class RenderOptions:
    """Options of a rendering; by default a camera orbits the person through all fitted frames, or through those trained
    on if the method has no new poses.

    camera: a recorded camera's name; path: a file or folder of cameras to fly along (`read_camera_path`); with neither,
    the camera orbits at this radius and at this height above the person's centre, in metres (`orbit`). motion: another
    subject's folder, a BVH or an AMASS file (`read_motion`), or T_POSE; frames: which of its frames (`select_frames`);
    between: two frames to interpolate between. shape: amounts added to shape values; volume: relative change. what:
    kinds of output, from OUTPUT_KINDS. size_px: the longest side of images. pictures: number of images.
    """

    camera: str | None = None
    path: Path | None = None
    radius_m: float | None = None
    height_m: float | None = None
    motion: Path | None = None
    frames: str = ":"
    between: tuple[int, int] | None = None
    shape: dict[str, float] = field(default_factory=dict)
    volume: float | None = None
    what: tuple[str, ...] = ("colour",)
    size_px: int | None = None
    pictures: int | None = None


def render_subject(subject: Path, options: RenderOptions, out: Path) -> int:
    """Render a subject (<store>/subjects/<name>) into the new folder `out`; return the number of images.

    See `write_pictures` for the files. Raises InputError if the options cannot be met.
    """
    with atomic_folder(out) as partial:
        capture = checked_capture(subject, options)
        if options.motion or options.between or options.shape or options.volume is not None:
            require_poses(subject, "another motion or shape")
        motion = chosen_motion(subject, options, capture)
        cameras = _cameras(options, capture, motion.body)
        shots: list[Shot] = list(zip(cameras, itertools.cycle(motion.body.frames), strict=False))
        avatar = avatar_of(subject)
        if options.between is not None:  # otherwise only the first and the last pose would have a frame's deformation
            avatar = avatar.without_frames()
        write_pictures(avatar.with_body(motion.body), shots, options.what, motion.fps, partial)
    return len(shots)


def checked_capture(subject: Path, options: RenderOptions) -> Capture:
    """Return the subject's capture with its calibrated cameras; raise InputError if files are missing or options are
    invalid."""
    require_files(subject, ("capture/capture.json", "calibration/intri.yml", "training/model.safetensors"))
    unknown = [kind for kind in options.what if kind not in OUTPUT_KINDS]
    if unknown or not options.what:
        raise InputError(f"--what {','.join(unknown)}: choose from {', '.join(OUTPUT_KINDS)}")
    if (options.camera or options.path) and (options.radius_m is not None or options.height_m is not None):
        raise InputError("--radius and --height are for an orbit; omit them, or omit --camera and --path")
    if options.between and options.frames != ":":
        raise InputError(f"--frames {options.frames}: has no effect with --between; leave it out")
    if options.motion == T_POSE and options.frames != ":":
        raise InputError(f"--frames {options.frames}: has no effect with --motion {T_POSE}; leave it out")
    if options.pictures is not None and options.pictures < 1:
        raise InputError(f"{options.pictures} pictures: give 1 or more")
    return recording_of(subject)


def chosen_motion(subject: Path, options: RenderOptions, capture: Capture) -> Motion:
    """Return the poses to show, on the body shape to show."""
    with readable(subject / "training"):
        own = BodyFit.load(subject / "training")
        if reason_without_novel_poses(subject / "training"):
            own = select_poses(own, tuple(frame for frame in own.frames if frame in capture.train_frames))
    if options.motion is None:
        motion = Motion(select_poses(own, select_frames(own.frames, options.frames, subject)), capture.fps, capture.up)
    else:
        posed = options.motion == T_POSE
        motion = t_pose_motion(own.rig) if posed else read_motion(options.motion, options.frames)
        motion = dataclasses.replace(motion, body=retarget(own, motion, capture.up, options.motion), up=capture.up)
    body = motion.body
    if options.between is not None:
        for frame in options.between:
            select_frames(body.frames, str(frame), options.motion or subject)
        body = interpolate_poses(body, *options.between, options.pictures or ORBIT_PICTURES)
    if options.shape or options.volume is not None:
        rig = with_shape_values(own.rig, options.shape)
        body = transfer_poses(rig if options.volume is None else with_volume(rig, options.volume), body, capture.up)
    return Motion(body, motion.fps, capture.up)


def _cameras(options: RenderOptions, capture: Capture, body: BodyFit) -> list[Camera]:
    """Return one camera per image."""
    recorded = [capture.cameras[name] for name in capture.train_cameras]
    poses = len(body.frames) if len(body.frames) > 1 else None
    if options.camera is not None:
        if options.camera not in capture.cameras:
            raise InputError(f"--camera {options.camera}: no such camera; there are {', '.join(capture.cameras)}")
        found = [capture.cameras[options.camera]] * (options.pictures or poses or 1)
    elif options.path is not None:
        keys = read_camera_path(options.path, capture.recorded_sizes_px[recorded[0].name])
        found = interpolate_cameras(keys, options.pictures or poses or len(keys))
    else:
        count = options.pictures or poses or ORBIT_PICTURES
        found = orbit(recorded, _middle_m(body), count, capture.up, options.radius_m, options.height_m)
    if options.camera is None:  # derived from recorded cameras, but without their exposure
        found = [dataclasses.replace(camera, name="") for camera in found]
    if options.size_px is not None:
        found = [camera.scaled(options.size_px / max(camera.size_px)) for camera in found]
    width_px, height_px = found[0].size_px  # the same for all cameras
    if min(width_px, height_px) < MIN_SIZE_PX or max(width_px, height_px) > MAX_SIZE_PX:
        sides = f"each side must have {MIN_SIZE_PX} to {MAX_SIZE_PX}"
        raise InputError(f"pictures of {width_px} x {height_px} px: {sides}; give another --size")
    return found


def _middle_m(body: BodyFit) -> np.ndarray:
    """Return the centre (3,) of the box around all poses, in the world."""
    poses = tracked(zip(body.theta, body.root, strict=True), "box of the motion", len(body.frames))
    bodies_m = (pose_vertices(body.rig, *pose) for pose in poses)
    corners_m = torch.stack([torch.stack([vertices_m.amin(0), vertices_m.amax(0)]) for vertices_m in bodies_m])
    return (corners_m[:, 0].amin(0) + corners_m[:, 1].amax(0)).double().numpy() / 2
