"""A capture in which the person wears what no body model expresses: a wide skirt, or long hair.

Both move in their own way: the skirt spans both thighs and its folds run around it, the hair hangs down and sways. They
are drawn over every picture, before or behind the body that was fitted to the good capture, and over what is known to
be true of it.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hnerf.body.descriptor import normals_of
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.subset import copy_files, write_arrays
from hnerf.evaluation.ground_truth import ON_BLACK, GroundTruth
from hnerf.geometry.rays import RayHits
from hnerf.synthetic.render import RayCaster, dome_lights, irradiance, render_person

Rng = np.random.Generator

NOSE, R_HIP, R_KNEE, L_HIP, L_KNEE, R_EAR, L_EAR = 0, 9, 10, 12, 13, 17, 18  # BODY_25
AROUND, ALONG = 64, 24  # vertices of a tube
ANGLES = 2 * np.pi * np.arange(AROUND)[:, None] / AROUND
FOLDS, FOLD_DEPTH = 8, 0.3  # of the skirt; depth as a share of how far the hem stands off
BACK, FALLS_BACK, WIDTH, THICKNESS = 0.55, 0.15, 0.65, 0.35  # of hair, in distances of the ears; metres a metre
SWAY = 0.15  # of the hair's length
STEP_RAD = 0.4  # by which folds and sway move on from frame to frame, at random
CLOTH = np.array([[0.45, 0.18, 0.20], [0.58, 0.34, 0.30]])  # of its checks
HAIR = np.array([[0.20, 0.12, 0.07], [0.30, 0.19, 0.11]])  # of its strands


@dataclass(frozen=True)
class Worn:
    """A closed tube in every frame: vertices_m (n, ALONG * AROUND + 2, 3), the last two in the middle of its ends; the
    colours (2, 3) of its pattern."""

    vertices_m: np.ndarray
    pattern: np.ndarray

    @staticmethod
    def tube(rings_m: np.ndarray, pattern: np.ndarray) -> "Worn":
        """Down rings (n, ALONG, AROUND, 3), each counter-clockwise seen from above."""
        ends_m = rings_m[:, [0, -1]].mean(2)
        return Worn(np.concatenate([rings_m.reshape(len(rings_m), -1, 3), ends_m], 1), pattern)

    @property
    def faces(self) -> np.ndarray:
        """(F, 3), counter-clockwise seen from outside."""
        ring, k = np.meshgrid(np.arange(ALONG - 1) * AROUND, np.arange(AROUND), indexing="ij")
        a, b = (ring + k).ravel(), (ring + (k + 1) % AROUND).ravel()
        first, following = np.arange(AROUND), (np.arange(AROUND) + 1) % AROUND
        top, last = np.full(AROUND, ALONG * AROUND), (ALONG - 1) * AROUND
        sides = [[a, b + AROUND, b], [a, a + AROUND, b + AROUND]]
        caps = [[first, following, top], [following + last, first + last, top + 1]]
        return np.concatenate([np.stack(corners, 1) for corners in (*sides, *caps)])

    @property
    def colours(self) -> np.ndarray:
        """Of vertices, (V, 3): checks."""
        ring, k = np.meshgrid(np.arange(ALONG), np.arange(AROUND), indexing="ij")
        which = (ring // 4 + k // 8) % 2
        return self.pattern[[*which.ravel(), 0, 0]]


@dataclass(frozen=True)
class Shown:
    """What is worn in a frame, lit, and the body that hides some of it; for `render_person`."""

    vertices_m: np.ndarray
    faces: np.ndarray
    colour: np.ndarray
    both: RayCaster

    @staticmethod
    def on(worn: Worn, row: int, body_m: np.ndarray, body_faces: np.ndarray, up: str) -> "Shown":
        """body_m (V, 3) of the same frame."""
        vertices_m, faces = worn.vertices_m[row], worn.faces
        both = RayCaster(np.concatenate([vertices_m, body_m]), np.concatenate([faces, body_faces + len(vertices_m)]))
        directions, strength = dome_lights()
        if up == "y":
            directions = directions[:, [0, 2, 1]] * [1, 1, -1]
        normals = normals_of(vertices_m, faces)
        visible = both.visibility(vertices_m + 3e-3 * normals, directions)
        light = irradiance(normals, visible, (directions, strength))
        return Shown(vertices_m, faces, (worn.colours * light[:, None]).clip(0, 1), both)

    def cast(self, origin_m: np.ndarray, directions: np.ndarray) -> RayHits:
        """First hits of rays from one origin (3,) along unit directions (N, 3); none where the body comes first."""
        hits = self.both.cast(origin_m, directions)
        return dataclasses.replace(hits, face=np.where(hits.face < len(self.faces), hits.face, -1))

    def colours(self, hits: RayHits) -> np.ndarray:
        """Lit colours in [0, 1] of those rays that hit, (M, 3)."""
        return hits.interpolate(self.colour, self.faces)


def skirt(keypoints_m: np.ndarray, up: np.ndarray, flare_m: float, rng: Rng) -> Worn:
    """From the hips to the knees of keypoints (n, 25, 3), around both thighs; how far its hem is off them."""
    right_hip, left_hip, right_knee, left_knee = (keypoints_m[:, k] for k in (R_HIP, L_HIP, R_KNEE, L_KNEE))
    width_m = float(np.linalg.norm(right_hip - left_hip, axis=1).mean())
    hips_m, knees_m = (right_hip + left_hip) / 2, (right_knee + left_knee) / 2
    left, back = _level_axes(left_hip - right_hip, hips_m - knees_m)
    outwards = np.cos(ANGLES) * left[:, None, None] + np.sin(ANGLES) * back[:, None, None]
    down = np.linspace(0, 1, ALONG)[:, None, None]
    folds = np.cos(FOLDS * ANGLES + _phases(len(keypoints_m), rng))
    hem_m = width_m / 2 + flare_m * (1 + FOLD_DEPTH * folds)
    half_apart_m = ((left_knee - right_knee) / 2)[:, None, None]
    side = np.tanh(2 * (outwards * half_apart_m / _lengths(half_apart_m)).sum(-1, keepdims=True))  # right -1, left 1
    middles_m = hips_m[:, None, None] * (1 - down) + (knees_m[:, None, None] + side * half_apart_m) * down
    return Worn.tube(middles_m + (width_m * (1 - down) + hem_m * down) * outwards, CLOTH)


def long_hair(keypoints_m: np.ndarray, up: np.ndarray, length_m: float, rng: Rng) -> Worn:
    """So far down from the back of the head, between the ears of keypoints (n, 25, 3); up (3,)."""
    ears_m = (keypoints_m[:, R_EAR] + keypoints_m[:, L_EAR]) / 2
    head_m = float(np.linalg.norm(keypoints_m[:, R_EAR] - keypoints_m[:, L_EAR], axis=1).mean())
    front, left = _level_axes(keypoints_m[:, NOSE] - ears_m, up)
    drop_m = np.linspace(0, length_m, ALONG)[:, None]
    sway_m = SWAY * drop_m**2 / length_m * np.sin(_phases(len(keypoints_m), rng)[:, 0])
    middles_m = ears_m[:, None] - drop_m * up - (BACK * head_m + FALLS_BACK * drop_m) * front[:, None]
    middles_m = middles_m + sway_m * left[:, None]
    outwards = THICKNESS * np.cos(ANGLES) * front[:, None, None] + WIDTH * np.sin(ANGLES) * left[:, None, None]
    return Worn.tube(middles_m[:, :, None] + head_m * outwards, HAIR)


WORN: dict[str, Callable[[np.ndarray, np.ndarray, float, Rng], Worn]] = {"skirt": skirt, "long_hair": long_hair}


def add_clothing(
    kind: str, strength: float, rng: Rng, capture: Capture, body: BodyFit, truth: GroundTruth, out: Path
) -> None:
    """Write the capture into `out`, every picture and given mask with what is WORN, and under `ground_truth/` what was
    known to be true. Keypoints stay: detectors guess what cloth hides. Board footage is left out."""
    bodies_m, faces = body.vertices_m().double().numpy(), body.rig.faces.numpy()
    rows = [body.index(frame) for frame in capture.frames]
    keypoints_m = body.rig.keypoint_weights.double().numpy() @ bodies_m[rows]
    worn = WORN[kind](keypoints_m, np.eye(3)["xyz".index(capture.up)], strength, rng)
    kept = dataclasses.replace(capture, root=out, frame_offsets={}, stored_frames=(), recorded_lenses={})
    write_arrays(capture, kept)
    for row, frame in enumerate(capture.frames):
        shown = Shown.on(worn, row, bodies_m[rows[row]], faces, capture.up)
        for name in capture.cameras:
            _draw(shown, capture, truth, name, frame, out)
    copy_files(capture.root / "background", out / "background", capture.cameras)
    kept.save()
    meshes = {frame: mesh for frame, mesh in truth.meshes().items() if frame in capture.frames}
    if meshes:
        vertices_m = [np.concatenate([worn.vertices_m[capture.frames.index(f)], m.vertices]) for f, m in meshes.items()]
        true_faces = next(iter(meshes.values())).faces + len(worn.vertices_m[0])
        (out / "ground_truth").mkdir(exist_ok=True)
        np.savez_compressed(
            out / "ground_truth" / "meshes.npz",
            faces=np.concatenate([worn.faces, true_faces]),
            vertices=np.stack(vertices_m),
            frames=np.array(list(meshes)),
        )


def _draw(shown: Shown, capture: Capture, truth: GroundTruth, camera: str, frame: int, out: Path) -> None:
    """One picture, its given mask, and its truth where it is known."""
    rgb, coverage, mask = render_person(shown, capture.cameras[camera])

    def over(pixels: np.ndarray) -> np.ndarray:
        return (255 * rgb + (1 - coverage[..., None]) * pixels).round().clip(0, 255).astype(np.uint8)

    def joined(person: np.ndarray) -> np.ndarray:
        return np.where(person | mask, 255, 0).astype(np.uint8)

    file = Path(camera) / f"{frame:06d}.png"
    write_image(out / "images" / file.with_suffix(".jpg"), over(capture.image(camera, frame)))
    given = capture.given_mask(camera, frame)
    if given is not None:
        write_image(out / "masks" / file, joined(given))
    if truth.has_mask(camera, frame):
        write_image(out / "ground_truth" / "masks" / file, joined(truth.mask(camera, frame)))
        write_image(out / ON_BLACK / file.with_suffix(".jpg"), over(truth.on_black(camera, frame)[0]))


def _phases(frames: int, rng: Rng) -> np.ndarray:
    """(frames, 1, 1, 1) radians: anywhere at first, then a little on or back."""
    steps = rng.normal(0, STEP_RAD, frames)
    steps[0] = rng.uniform(0, 2 * np.pi)
    return steps.cumsum()[:, None, None, None]


def _level_axes(towards: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (n, 3) at right angles to up, (3,) or (n, 3): along `towards` (n, 3), and to the left of it."""
    level, left = towards - up * ((towards * up).sum(-1) / (up * up).sum(-1))[:, None], np.cross(up, towards)
    return level / _lengths(level), left / _lengths(left)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
