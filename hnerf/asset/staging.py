"""The clothed avatar in the axes of asset formats: right-handed, Y up, metres; shared by all writers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hnerf.asset.albedo import Albedo
from hnerf.asset.correctives import Correctives
from hnerf.asset.levels import Level, levels_of
from hnerf.asset.motions import Motion, is_dense, motion_of, resampled
from hnerf.asset.rigs import FULL, GAME, RestSurface, StagedRig, stage_rigs
from hnerf.asset.skeleton import Bones
from hnerf.asset.texture import UvLayout
from hnerf.body.descriptor import normals_of
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.body.skeletons import OWN, JointNames
from hnerf.geometry.axes import Y_UP_FROM_Z_UP, y_up_from
from hnerf.geometry.camera import Camera
from hnerf.progress import tracked

CAPTURED = "captured"  # the motion at the capture's own rate, whose time codes are the capture's frames
RATES = (24, 30)  # frames a second at which it is resampled, since many importers ignore a file's rate
SMALL_WEIGHT = 1e-3  # at which correctives change normals in proportion to it
STILL_M = 1e-5  # points that a blend shape moves by less count as unmoved
REST_POSE = "A"  # of every body model here: arms slanting down


@dataclass(frozen=True)
class StagedAvatar:
    """The arrays of an avatar ready to be written; numpy, float64 and int64 unless stated otherwise.

    rest_points_m (V, 3), the soles at height 0. levels: the mesh at full detail, then with fewer and fewer faces.
    shapes_m (K, V, 3) float32: corrective blend shapes, applied before the skin; expressions_m (V, 3) float32, by name:
    blend shapes of the face, which no motion uses; physiques_m, likewise: other physiques around the same bones. rigs:
    "full", with all joints of the body model, and "game", with few joints and influences. frames (n,): of the capture;
    points_m (n, V, 3) float32: the surface in each frame. extents_m (n, 2, 3), by motion: the box at each time code.
    texture (H, W, 3) uint8 sRGB. stage_from_world (3, 3): a rotation. albedo, with its light in the stage, and
    normal_map (S, S, 3) uint8, in tangent space, if there are any. joint_names: the skeleton after which files name the
    joints; the rigs have their own names.
    """

    rest_points_m: np.ndarray
    levels: Sequence[Level]
    shapes_m: np.ndarray
    expressions_m: dict[str, np.ndarray]
    physiques_m: dict[str, np.ndarray]
    rigs: dict[str, StagedRig]
    frames: np.ndarray
    points_m: np.ndarray
    extents_m: dict[str, np.ndarray]
    texture: np.ndarray
    stage_from_world: np.ndarray
    albedo: Albedo | None
    normal_map: np.ndarray | None
    joint_names: JointNames

    @property
    def rates(self) -> tuple[int, ...]:
        """Return the rates at which the captured motion is resampled: all of RATES, or none if its poses are too far
        apart."""
        return tuple(rate for rate in RATES if f"{CAPTURED}_{rate}" in self.extents_m)

    @property
    def faces(self) -> np.ndarray:
        """Return the faces (F, 3) at full detail."""
        return self.levels[0].faces

    @property
    def uvs(self) -> np.ndarray:
        """Return the texture coordinates (U, 2), v up, at full detail."""
        return self.levels[0].layout.uvs.astype(np.float64)

    @property
    def face_uvs(self) -> np.ndarray:
        """Return the rows (F, 3) of `uvs` of the faces' corners."""
        return self.levels[0].layout.face_uvs

    @cached_property
    def normals(self) -> np.ndarray:
        """Return the unit normals (V, 3) of the surface at rest."""
        return normals_of(self.rest_points_m, self.faces)

    @property
    def blend_shapes_m(self) -> dict[str, np.ndarray]:
        """Return the correctives and the expressions, (V, 3), by name."""
        return dict(zip(shape_names(self), self.shapes_m, strict=True)) | self.expressions_m

    @cached_property
    def normal_changes(self) -> dict[str, np.ndarray]:
        """Return how correctives, expressions and physiques change the normals per weight, (V, 3) float32, by name.

        Correctives act together and largely cancel each other, so theirs are the derivatives at rest. `mouthClose`
        closes a jaw that `jawOpen` has opened, so its changes are from the open mouth.
        """

        def change(moved_m: np.ndarray, weight: float = 1.0, start_m: np.ndarray | float = 0.0) -> np.ndarray:
            points_m = self.rest_points_m + start_m
            changed = normals_of(points_m + weight * moved_m, self.faces) - normals_of(points_m, self.faces)
            return (changed / weight).astype(np.float32)

        correctives = zip(shape_names(self), self.shapes_m, strict=True)
        changes = {name: change(moved_m, SMALL_WEIGHT) for name, moved_m in correctives}
        changes |= {name: change(moved_m) for name, moved_m in (self.expressions_m | self.physiques_m).items()}
        if "mouthClose" in changes:
            changes["mouthClose"] = change(self.expressions_m["mouthClose"], start_m=self.expressions_m["jawOpen"])
        return changes

    @property
    def looks(self) -> dict[str, np.ndarray]:
        """Return the texture of each look, by name."""
        return {"captured": self.texture} | ({"albedo": self.albedo.texture} if self.albedo else {})

    @property
    def rest(self) -> RestSurface:
        """Return the surface that rigs move."""
        return RestSurface(self.rest_points_m, self.shapes_m)

    @property
    def vertex_colours(self) -> np.ndarray:
        """Return the texture's colour at each vertex, (V, 3) uint8 sRGB."""
        height, width = self.texture.shape[:2]
        uv = np.zeros((len(self.rest_points_m), 2))
        uv[self.faces] = self.uvs[self.face_uvs]
        column = (uv[:, 0] * width).astype(int).clip(0, width - 1)
        row = ((1 - uv[:, 1]) * height).astype(int).clip(0, height - 1)
        return self.texture[row, column]


def stage_avatar(
    clothed: BodyFit,
    surfaces_m: np.ndarray,
    correctives: Correctives,
    layout: UvLayout,
    texture: np.ndarray,
    up: str,
    fps: float,
    bones: Bones = "along",
    further: Mapping[str, tuple[BodyFit, float]] = {},
    albedo: Albedo | None = None,
    normal_map: np.ndarray | None = None,
    level_faces: Sequence[int] = (),
    expressions_m: Mapping[str, np.ndarray] = {},
    physiques_m: Mapping[str, np.ndarray] = {},
    joint_names: JointNames = OWN,
) -> StagedAvatar:
    """Turn a clothed body (see `clothed_rig`) and its motion to Y up, with both rigs. surfaces_m (n, V, 3): its surface
    in each frame; `up`: the vertical axis of the world, "y" or "z"; fps: of the frames; further: motions of the same
    joints in the same world with their frame rates, by name; albedo: with its light in the world; level_faces: face
    counts of the lower levels of detail; expressions_m, physiques_m (V, 3): of the face and of other bodies, in the
    body's axes."""
    world, rig, body = y_up_from(up), clothed.rig, Y_UP_FROM_Z_UP
    rest_m, joints_m = _at_rest(rig)
    rest = RestSurface(rest_m, correctives.offsets_m @ body.T.astype(np.float32))
    points_m = surfaces_m @ world.T.astype(np.float32)
    motions = _motions(clothed, fps, correctives.weights, further, world)
    floor_m = float(np.median(points_m[..., 1].min(1)))  # the median, since some frames have a foot centimetres lower
    rigs = stage_rigs(rig, joints_m, rest, motions, floor_m, bones)
    return StagedAvatar(
        rest_points_m=rest.points_m,
        levels=levels_of(rest.points_m, rig.faces.numpy(), layout, level_faces, expressions_m),
        shapes_m=rest.shapes_m,
        expressions_m=_turned(expressions_m, body),
        physiques_m=_turned(physiques_m, body),
        rigs=rigs,
        frames=np.array(clothed.frames),
        points_m=points_m,
        extents_m={name: _boxes(rigs, name, rest) for name in motions},
        texture=texture,
        stage_from_world=world,
        albedo=None if albedo is None else Albedo(albedo.texture, albedo.light.turned(world)),
        normal_map=normal_map,
        joint_names=joint_names,
    )


def stage_body(body: BodyFit, up: str, fps: float) -> tuple[StagedRig, np.ndarray]:
    """Return the game rig of a fitted body, with its captured motion alone and its root at height 0, and the surface
    (V, 3) at rest that follows it; `up` and fps as for `stage_avatar`."""
    rest_m, joints_m = _at_rest(body.rig)
    captured = motion_of(body, fps, np.zeros((len(body.frames), 0)), y_up_from(up))
    rest = RestSurface(rest_m, np.zeros((0, *rest_m.shape)))
    return stage_rigs(body.rig, joints_m, rest, {CAPTURED: captured}, 0.0, "along")[GAME], rest_m


def _at_rest(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (V, 3) and the joints (S, 3) of a body at rest, Y up, standing at the origin."""
    rest_m, joints_m = (m.double().numpy() @ Y_UP_FROM_Z_UP.T for m in (rig.vertices_m, rig.joints_m))
    stands_m = np.array([joints_m[0, 0], rest_m[:, 1].min(), joints_m[0, 2]])
    return rest_m - stands_m, joints_m - stands_m


def shape_names(avatar: StagedAvatar) -> list[str]:
    """Return the names of the corrective blend shapes."""
    return [f"corrective_{k + 1:02d}" for k in range(len(avatar.shapes_m))]


def _turned(shapes_m: Mapping[str, np.ndarray], rotation: np.ndarray) -> dict[str, np.ndarray]:
    """Turn blend shapes (V, 3), by name."""
    return {name: moved_m @ rotation.T.astype(np.float32) for name, moved_m in shapes_m.items()}


def box(points_m: np.ndarray) -> np.ndarray:
    """Return the lower and the upper corner (2, 3) of the box around points (n, 3)."""
    return np.stack([points_m.min(0), points_m.max(0)])


def moved_points(offsets_m: np.ndarray) -> np.ndarray:
    """Return which points a blend shape (V, 3) moves, (n,); the first one if it moves none, since formats take an empty
    list for all points."""
    moved = np.flatnonzero(np.abs(offsets_m).max(1) > STILL_M)
    return moved if len(moved) else np.zeros(1, np.int64)


def opengl_pose(camera: Camera, stage_from_world: np.ndarray) -> np.ndarray:
    """Return a camera's transform in the stage (4, 4), with the axes of OpenGL, USD and glTF: x right, y up, looking
    along -z."""
    pose = np.eye(4)
    pose[:3, :3] = stage_from_world @ camera.R.T @ np.diag([1, -1, -1])
    pose[:3, 3] = stage_from_world @ camera.centre_m
    return pose


def _motions(
    clothed: BodyFit, fps: float, weights: np.ndarray, further: Mapping[str, tuple[BodyFit, float]], world: np.ndarray
) -> dict[str, Motion]:
    """Return the captured motion first, then the same motion at other rates unless its poses are more than LONGEST_S
    apart on average, then further ones, which have no blend shapes and begin at the captured motion's first
    instant."""
    captured = motion_of(clothed, fps, weights, world)
    motions = {CAPTURED: captured}
    if is_dense(captured.seconds):
        motions |= {f"{CAPTURED}_{rate}": resampled(captured, rate) for rate in RATES}
    for name, (body, rate) in further.items():
        motion = motion_of(body, rate, np.zeros((len(body.frames), weights.shape[1]), np.float32), world)
        motions[name] = replace(motion, codes=motion.codes - motion.codes[0] + captured.seconds[0] * rate)
    return motions


def _boxes(rigs: Mapping[str, StagedRig], motion: str, rest: RestSurface) -> np.ndarray:
    """Return the box (2, 3) of the surface at each time code of a motion, (n, 2, 3), whichever rig moves it."""
    surfaces_m = zip(*(rig.surfaces_m(motion, rest) for rig in rigs.values()), strict=True)
    count = len(rigs[FULL].motions[motion].codes)
    return np.stack([box(np.concatenate(both_m)) for both_m in tracked(surfaces_m, f"boxes of {motion}", count)])
