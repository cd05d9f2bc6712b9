"""Clothing that no body model can represent, drawn into a capture: a wide skirt, or long hair.

Both move independently of the body: the skirt spans both thighs and its folds run around it; the hair hangs down and
sways. They are drawn over every image, in front of or behind the body that was fitted to the good capture, and over the
ground truth.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hnerf.body.descriptor import normals_of
from hnerf.body.fit_result import BodyFit
from hnerf.capture.board_footage import BOARDS_FILE
from hnerf.capture.body_25 import Body25
from hnerf.capture.capture import PERSON, Capture, to_8_bit, write_image
from hnerf.capture.subset import copy_files, write_arrays
from hnerf.evaluation.ground_truth import ON_BLACK, GroundTruth
from hnerf.geometry.rays import RayHits, cast, mesh_on_cpu
from hnerf.synthetic.render import dome_lights, irradiance, render_person, visibility
from hnerf.warp_import import wp

Rng = np.random.Generator

RING_VERTICES, RINGS = 64, 24  # of a tube
ANGLES = 2 * np.pi * np.arange(RING_VERTICES)[:, None] / RING_VERTICES
FOLDS, FOLD_DEPTH = 8, 0.3  # of the skirt; the depth is a share of the hem's distance
# Of the hair: offset behind the head, width and thickness in ear distances; backward slope in metres per metre length.
BACK, FALLS_BACK, WIDTH, THICKNESS = 0.55, 0.15, 0.65, 0.35
SWAY = 0.15  # amplitude as a share of the hair's length
STEP_RAD = 0.4  # standard deviation of the phase step of folds and sway from frame to frame
CLOTH = np.array([[0.45, 0.18, 0.20], [0.58, 0.34, 0.30]])  # two colours of the checks
HAIR = np.array([[0.20, 0.12, 0.07], [0.30, 0.19, 0.11]])  # two colours of the checks


@dataclass(frozen=True)
class Garment:
    """A closed tube in every frame. vertices_m (n, RINGS * RING_VERTICES + 2, 3): the last two are the centres of its
    ends; pattern: the two colours (2, 3) of its checks."""

    vertices_m: np.ndarray
    pattern: np.ndarray

    @staticmethod
    def tube(rings_m: np.ndarray, pattern: np.ndarray) -> "Garment":
        """Return the tube through rings (n, RINGS, RING_VERTICES, 3), from the top down, each counter-clockwise seen
        from above."""
        ends_m = rings_m[:, [0, -1]].mean(2)
        return Garment(np.concatenate([rings_m.reshape(len(rings_m), -1, 3), ends_m], 1), pattern)

    @property
    def faces(self) -> np.ndarray:
        """Return the triangles (F, 3), counter-clockwise seen from outside."""
        ring, k = np.meshgrid(np.arange(RINGS - 1) * RING_VERTICES, np.arange(RING_VERTICES), indexing="ij")
        a, b = (ring + k).ravel(), (ring + (k + 1) % RING_VERTICES).ravel()
        first, following = np.arange(RING_VERTICES), (np.arange(RING_VERTICES) + 1) % RING_VERTICES
        top, last = np.full(RING_VERTICES, RINGS * RING_VERTICES), (RINGS - 1) * RING_VERTICES
        sides = [[a, b + RING_VERTICES, b], [a, a + RING_VERTICES, b + RING_VERTICES]]
        caps = [[first, following, top], [following + last, first + last, top + 1]]
        return np.concatenate([np.stack(corners, 1) for corners in (*sides, *caps)])

    @property
    def colours(self) -> np.ndarray:
        """Return the vertices' colours, (V, 3), in a check pattern."""
        ring, k = np.meshgrid(np.arange(RINGS), np.arange(RING_VERTICES), indexing="ij")
        which = (ring // 4 + k // 8) % 2
        return self.pattern[[*which.ravel(), 0, 0]]


@dataclass(frozen=True)
class LitGarment:
    """A lit garment in one frame, with the body that occludes part of it; for `render_person`."""

    vertices_m: np.ndarray
    faces: np.ndarray
    colour: np.ndarray
    both: wp.Mesh

    @staticmethod
    def over_body(garment: Garment, row: int, body_m: np.ndarray, body_faces: np.ndarray, up: str) -> "LitGarment":
        """Return the lit garment in frame `row`, over the body's vertices body_m (V, 3) of the same frame."""
        vertices_m, faces = garment.vertices_m[row], garment.faces
        both = mesh_on_cpu(np.concatenate([vertices_m, body_m]), np.concatenate([faces, body_faces + len(vertices_m)]))
        directions, strength = dome_lights()
        if up == "y":
            directions = directions[:, [0, 2, 1]] * [1, 1, -1]
        normals = normals_of(vertices_m, faces)
        visible = visibility(both, vertices_m + 3e-3 * normals, directions)
        light = irradiance(normals, visible, (directions, strength))
        return LitGarment(vertices_m, faces, (garment.colours * light[:, None]).clip(0, 1), both)

    def cast(self, origin_m: np.ndarray, directions: np.ndarray) -> RayHits:
        """Return the first hits of rays from one origin (3,) along unit directions (N, 3); no hit where the body is in
        front."""
        hits = cast(self.both, origin_m, directions)
        return dataclasses.replace(hits, face=np.where(hits.face < len(self.faces), hits.face, -1))

    def colours(self, hits: RayHits) -> np.ndarray:
        """Return the lit colours in [0, 1] of the rays that hit, (M, 3)."""
        return hits.interpolate(self.colour, self.faces)


def skirt(keypoints_m: np.ndarray, up: np.ndarray, flare_m: float, rng: Rng) -> Garment:
    """Return a skirt around both thighs, from the hips to the knees of keypoints (n, 25, 3). flare_m: distance of its
    hem from the thighs."""
    right_hip, left_hip, right_knee, left_knee = (
        keypoints_m[:, k] for k in (Body25.R_HIP, Body25.L_HIP, Body25.R_KNEE, Body25.L_KNEE)
    )
    width_m = float(np.linalg.norm(right_hip - left_hip, axis=1).mean())
    hips_m, knees_m = (right_hip + left_hip) / 2, (right_knee + left_knee) / 2
    left, back = _level_axes(left_hip - right_hip, hips_m - knees_m)
    outwards = np.cos(ANGLES) * left[:, None, None] + np.sin(ANGLES) * back[:, None, None]
    down = np.linspace(0, 1, RINGS)[:, None, None]
    folds = np.cos(FOLDS * ANGLES + _phases(len(keypoints_m), rng))
    hem_m = width_m / 2 + flare_m * (1 + FOLD_DEPTH * folds)
    half_apart_m = ((left_knee - right_knee) / 2)[:, None, None]
    side = np.tanh(2 * (outwards * half_apart_m / _lengths(half_apart_m)).sum(-1, keepdims=True))  # right -1, left 1
    middles_m = hips_m[:, None, None] * (1 - down) + (knees_m[:, None, None] + side * half_apart_m) * down
    return Garment.tube(middles_m + (width_m * (1 - down) + hem_m * down) * outwards, CLOTH)


def long_hair(keypoints_m: np.ndarray, up: np.ndarray, length_m: float, rng: Rng) -> Garment:
    """Return hair of length length_m that hangs from the back of the head, between the ears of keypoints (n, 25, 3). up
    (3,)."""
    ears_m = (keypoints_m[:, Body25.R_EAR] + keypoints_m[:, Body25.L_EAR]) / 2
    head_m = float(np.linalg.norm(keypoints_m[:, Body25.R_EAR] - keypoints_m[:, Body25.L_EAR], axis=1).mean())
    front, left = _level_axes(keypoints_m[:, Body25.NOSE] - ears_m, up)
    drop_m = np.linspace(0, length_m, RINGS)[:, None]
    sway_m = SWAY * drop_m**2 / length_m * np.sin(_phases(len(keypoints_m), rng)[:, 0])
    middles_m = ears_m[:, None] - drop_m * up - (BACK * head_m + FALLS_BACK * drop_m) * front[:, None]
    middles_m = middles_m + sway_m * left[:, None]
    outwards = THICKNESS * np.cos(ANGLES) * front[:, None, None] + WIDTH * np.sin(ANGLES) * left[:, None, None]
    return Garment.tube(middles_m[:, :, None] + head_m * outwards, HAIR)


def add_clothing(
    sew: Callable[[np.ndarray, np.ndarray, float, Rng], Garment],
    capture: Capture,
    body: BodyFit,
    truth: GroundTruth,
    strength: float,
    rng: Rng,
    out: Path,
) -> None:
    """Write the capture into `out` with a garment drawn into every image and mask, and into the ground truth under
    `ground_truth/`. sew: `skirt` or `long_hair`. Keypoints stay, since detectors guess what cloth hides. Board footage
    is omitted."""
    bodies_m, faces = body.vertices_m().double().numpy(), body.rig.faces.numpy()
    rows = [body.index(frame) for frame in capture.frames]
    keypoints_m = body.rig.keypoint_weights.double().numpy() @ bodies_m[rows]
    garment = sew(keypoints_m, np.eye(3)["xyz".index(capture.up)], strength, rng)
    kept = dataclasses.replace(capture, root=out, frame_offsets={}, stored_frames=(), recorded_lenses={})
    write_arrays(capture, kept)
    (out / BOARDS_FILE).unlink(missing_ok=True)
    for row, frame in enumerate(capture.frames):
        lit_garment = LitGarment.over_body(garment, row, bodies_m[rows[row]], faces, capture.up)
        for name in capture.cameras:
            _draw(lit_garment, capture, truth, name, frame, out)
    copy_files(capture.root / "background", out / "background", capture.cameras)
    kept.save()
    meshes = {frame: mesh for frame, mesh in truth.meshes().items() if frame in capture.frames}
    if meshes:
        vertices_m = [
            np.concatenate([garment.vertices_m[capture.frames.index(f)], m.vertices]) for f, m in meshes.items()
        ]
        true_faces = next(iter(meshes.values())).faces + len(garment.vertices_m[0])
        (out / "ground_truth").mkdir(exist_ok=True)
        np.savez_compressed(
            out / "ground_truth" / "meshes.npz",
            faces=np.concatenate([garment.faces, true_faces]),
            vertices=np.stack(vertices_m),
            frames=np.array(list(meshes)),
        )


def _draw(lit_garment: LitGarment, capture: Capture, truth: GroundTruth, camera: str, frame: int, out: Path) -> None:
    """Write one image, its given and its detected mask, and its ground truth, if there is one."""
    rgb, coverage, mask = render_person(lit_garment, capture.cameras[camera])

    def over(pixels: np.ndarray) -> np.ndarray:
        return to_8_bit(255 * rgb + (1 - coverage[..., None]) * pixels)

    def joined(person: np.ndarray) -> np.ndarray:
        return np.where(person | mask, 255, 0).astype(np.uint8)

    file = Path(camera) / f"{frame:06d}.png"
    write_image(out / "images" / file.with_suffix(".jpg"), over(capture.image(camera, frame)))
    given = capture.given_mask(camera, frame)
    if given is not None:
        write_image(out / "masks" / file, joined(given))
    likely = capture.person_probability(camera, frame)
    if likely is not None:
        write_image(out / PERSON / file, np.where(mask, 255, 255 * likely).round().astype(np.uint8))
    if truth.has_mask(camera, frame):
        write_image(out / "ground_truth" / "masks" / file, joined(truth.mask(camera, frame)))
        write_image(out / ON_BLACK / file.with_suffix(".jpg"), over(truth.on_black(camera, frame)[0]))


def _phases(frames: int, rng: Rng) -> np.ndarray:
    """Return phases (frames, 1, 1, 1) in radians: a random walk in small steps from a random start."""
    steps = rng.normal(0, STEP_RAD, frames)
    steps[0] = rng.uniform(0, 2 * np.pi)
    return steps.cumsum()[:, None, None, None]


def _level_axes(towards: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (n, 3) perpendicular to up, (3,) or (n, 3): along `towards` (n, 3), and to the left of it."""
    level, left = towards - up * ((towards * up).sum(-1) / (up * up).sum(-1))[:, None], np.cross(up, towards)
    return level / _lengths(level), left / _lengths(left)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
