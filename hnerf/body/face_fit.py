"""The face: the rest body's features, moved to where a network sees them in photographs.

The network also looks at the fitted body, rendered from the same cameras: errors that are alike in both cancel.
"""

import dataclasses
import logging
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial.distance import cdist

from hnerf.body.descriptor import normals_of
from hnerf.body.fit_result import BodyFit
from hnerf.body.reprojection import project
from hnerf.body.rig import Rig, pose_vertices, vertex_skinning
from hnerf.capture.body_25 import EARS, Body25
from hnerf.capture.capture import Capture
from hnerf.detection.faces import POINTS, SIZE, FaceNetwork
from hnerf.detection.region import Region, upright_angle
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import cast, mesh_on_cpu
from hnerf.side_by_side import side_by_side
from hnerf.warp_import import wp

log = logging.getLogger("hnerf.fit")

TOWARDS_EARS, BELOW_M, SIDE_M = 0.3, 0.035, 0.3  # a head's region: its middle from the eyes, and its side
MOST_VIEWS = 24  # photographs looked at, evenly spaced
FACING = 0.5  # least cosine between where the face looks and the direction to the camera
LEAST_SIDE_PX = 24  # of a region: with fewer pixels, no face can be found
FOUND = 0.9  # least probability of a face in a photograph
LEAST_VIEWS = 3  # photographs with a face; with fewer, the face stays as it is
LIGHT = np.array([0, -0.6, -0.8])  # direction towards the light in camera axes: from above, behind the camera
# Standard deviation of a point in the mean of a camera's photographs, whose errors are alike; and the difference from
# which a point hardly counts.
POINT_STD_M, OUTLIER_M = 0.002, 0.02
CHANGE_STD_M = np.array([0.01, 0.001, 0.01])  # a priori, to the left, ahead and up: views from the front hide depth
SOLVES = 5  # each with the weights that the one before leaves
REACH_M = 0.015  # standard deviation of the Gaussian by which the skin follows the points around it


@dataclass(frozen=True)
class Photograph:
    """A photograph that may show the face, in a region."""

    camera: Camera
    frame: int
    region: Region


@dataclass(frozen=True)
class FaceView:
    """The points of the face in one photograph. camera: its name; rest_m (468, 3): where the network's points on the
    rendered body lie at rest, NaN where they miss it; seen_m (468, 2): how much farther right and down they are in the
    photograph, at the body's depth; by_rest (468, 2, 3): the derivative of that by the rest position."""

    camera: str
    rest_m: np.ndarray
    seen_m: np.ndarray
    by_rest: np.ndarray


def fit_face(capture: Capture, fit: BodyFit) -> BodyFit:
    """Return the fit with the face of its rest body moved to where photographs of the training frames show it; the same
    fit if fewer than LEAST_VIEWS show it. Raises InputError if the network or an image is missing."""
    network, photographs = FaceNetwork(), evenly_spaced(photographs_of_face(capture, fit), MOST_VIEWS)

    def view(photo: Photograph) -> FaceView | None:
        return _view(capture.image(photo.camera.name, photo.frame), photo, fit, network)

    views = [found for found in side_by_side(view, photographs) if found]
    few = len(views) < LEAST_VIEWS
    log.info("face: found in %d of %d photographs%s", len(views), len(photographs), ": stays as it is" if few else "")
    if few:
        return fit
    points_m, changes_m = solve_changes(views, rest_axes(fit.rig)[1])
    return dataclasses.replace(fit, rig=moved_face(fit.rig, points_m, changes_m))


def photographs_of_face(capture: Capture, fit: BodyFit) -> list[Photograph]:
    """Return the photographs, by training camera, then frame, in which the body looks towards the camera and the whole
    head is in the image, in a region of LEAST_SIDE_PX or more."""
    photographs = []
    for frame in capture.train_frames:
        vertices_m = pose_vertices(fit.rig, *fit.pose(frame))
        middle_m, (_, ahead, up) = face_axes((fit.rig.keypoint_weights @ vertices_m).double().numpy())
        for camera in (capture.cameras[name] for name in capture.train_cameras):
            towards = camera.centre_m - middle_m
            pixels, (depth_m, _) = camera.project(np.stack([middle_m, middle_m + 0.1 * up]))
            side_px = SIDE_M * camera.K[0, 0] / depth_m
            region = Region(pixels[0], side_px, upright_angle(pixels[1] - pixels[0]))
            corners_px = region.to_image(np.array([[0, 0], [0, 1], [1, 0], [1, 1]]), 1)
            large = side_px >= LEAST_SIDE_PX  # negative if the head is behind the camera
            if large and towards @ ahead > FACING * np.linalg.norm(towards) and camera.holds(corners_px).all():
                photographs.append(Photograph(camera, frame, region))
    return sorted(photographs, key=lambda photo: photo.camera.name)


def face_axes(keypoints_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of a head's region (3,), and unit vectors to the face's left, ahead and up (3, 3), from BODY_25
    keypoints (25, 3)."""
    eyes_m, ears_m = keypoints_m[[Body25.R_EYE, Body25.L_EYE]].mean(0), keypoints_m[list(EARS)].mean(0)
    left = keypoints_m[Body25.L_EYE] - keypoints_m[Body25.R_EYE]
    left = left / np.linalg.norm(left)
    ahead = eyes_m - ears_m - (eyes_m - ears_m) @ left * left
    ahead = ahead / np.linalg.norm(ahead)
    up = np.cross(ahead, left)
    return eyes_m + TOWARDS_EARS * (ears_m - eyes_m) - BELOW_M * up, np.stack([left, ahead, up])


def rest_axes(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Return `face_axes` of a body at rest."""
    return face_axes((rig.keypoint_weights @ rig.vertices_m).double().numpy())


def solve_changes(views: list[FaceView], axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rest positions of the points (K, 3) that any view has, medians over the views, and how they must
    change (K, 3), metres: robust least squares, in which all views of a point by one camera together count as one. axes
    (3, 3): of the face at rest."""
    has = ~np.isnan([view.rest_m[:, 0] for view in views])
    some = has.any(0)
    seen_m, by_rest = (np.array([getattr(view, name)[some] for view in views]) for name in ("seen_m", "by_rest"))
    names, has = np.array([view.camera for view in views]), has[:, some].astype(float)
    trust = has / (POINT_STD_M**2 * np.maximum((names[:, None] == names) @ has, 1))
    prior, change_m = axes.T / CHANGE_STD_M**2 @ axes, np.zeros((some.sum(), 3))
    for _ in range(SOLVES):
        off_m = seen_m - np.einsum("vkic,kc->vki", by_rest, change_m)
        weight = trust / (1 + ((off_m / OUTLIER_M) ** 2).sum(-1)) ** 2  # Geman-McClure
        matrix = np.einsum("vk,vkic,vkid->kcd", weight, by_rest, by_rest) + prior
        pull = np.einsum("vk,vkic,vki->kc", weight, by_rest, seen_m)
        change_m = np.linalg.solve(matrix, pull[..., None])[..., 0]
    return np.nanmedian([view.rest_m[some] for view in views], 0), change_m


def moved_face(rig: Rig, points_m: np.ndarray, changes_m: np.ndarray) -> Rig:
    """Return the rig with its skin moved as points (K, 3) of the face change (K, 3), left and right alike.

    A vertex moves by the mean over points and their mirror images, weighted by a Gaussian of the distance, and over a
    weight of 1 that stays: far from all points, nothing moves.
    """
    middle_m, (left, _, _) = rest_axes(rig)
    mirrored = np.eye(3) - 2 * np.outer(left, left)
    points_m = np.concatenate([points_m, middle_m + (points_m - middle_m) @ mirrored])
    weight = np.exp(-((cdist(rig.vertices_m.double().numpy(), points_m) / REACH_M) ** 2) / 2)
    moved_m = weight @ np.concatenate([changes_m, changes_m @ mirrored]) / (1 + weight.sum(1, keepdims=True))
    return dataclasses.replace(rig, vertices_m=rig.vertices_m + torch.from_numpy(moved_m).to(rig.vertices_m))


def _view(image: np.ndarray, photo: Photograph, fit: BodyFit, network: FaceNetwork) -> FaceView | None:
    """Return the points of the face in a photograph; None if the network finds no face there."""
    camera, region, faces = photo.camera, photo.region, fit.rig.faces.numpy()
    seen, probability = network(region.crop(image, SIZE))
    if probability < FOUND:
        return None
    rest_m = fit.rig.vertices_m.double()
    skinning = vertex_skinning(fit.rig, *fit.pose(photo.frame)).double()
    turn = skinning[..., :3]
    vertices_m = ((turn @ rest_m[..., None])[..., 0] + skinning[..., 3]).numpy()
    mesh = mesh_on_cpu(vertices_m, faces)
    rendered, _ = network(_rendered(mesh, normals_of(vertices_m, faces), faces, photo))
    hits = cast(mesh, *camera.rays(region.to_image(rendered, SIZE)))
    met = np.full((POINTS, 15), np.nan)  # at the points: position at rest, position, turn from rest
    met[hits.face >= 0] = hits.interpolate(np.hstack([rest_m.numpy(), vertices_m, turn.flatten(1).numpy()]), faces)
    met[np.linalg.norm(met[:, :3] - rest_axes(fit.rig)[0], axis=1) > SIDE_M / 2] = np.nan  # on a hand before the face
    metres = SIDE_M / region.side_px  # a pixel spans
    by_world = project(camera, torch.from_numpy(met[:, 3:6]))[1].numpy()
    by_rest = metres * by_world @ met[:, 6:].reshape(-1, 3, 3)
    seen_m = metres * (region.to_image(seen, SIZE) - region.to_image(rendered, SIZE))
    return FaceView(camera.name, met[:, :3], seen_m, np.nan_to_num(by_rest))


def _rendered(mesh: wp.Mesh, normals: np.ndarray, faces: np.ndarray, photo: Photograph) -> np.ndarray:
    """Render a body with vertex normals (V, 3) in grey on white, as sharp as the photograph, (SIZE, SIZE, 3) uint8."""
    size = min(SIZE, round(photo.region.side_px))
    places = np.stack(np.meshgrid(*2 * [np.arange(size) + 0.5]), -1).reshape(-1, 2)
    hits = cast(mesh, *photo.camera.rays(photo.region.to_image(places, size)))
    lit = (hits.interpolate(normals, faces) @ photo.camera.R.T @ LIGHT).clip(0, 1)
    picture = np.full(size**2, 255, np.uint8)
    picture[hits.face >= 0] = 105 + 105 * lit
    enlarged = cv2.resize(picture.reshape(size, size), (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    return np.repeat(enlarged[..., None], 3, -1)
