"""Rows of images for the report: the photograph, what was reconstructed from it, and the error."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import pose_vertices
from hnerf.evaluation import pictures
from hnerf.evaluation.ground_truth import GIVEN_MASKED_IMAGE, GroundTruth
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.evaluation.metrics import COVERED_LEVEL
from hnerf.evaluation.views import TRAINING_VIEW, View
from hnerf.geometry.mesh_queries import Surface


@dataclass(frozen=True)
class GalleryPicture:
    """A captioned image as a data URI."""

    caption: str
    uri: str


@dataclass(frozen=True)
class Row:
    """The images of one view or frame."""

    title: str
    note: str
    pictures: list[GalleryPicture]


@dataclass(frozen=True)
class Gallery:
    """Rows under one heading."""

    title: str
    text: str
    rows: list[Row]


def view_row(
    view: View,
    rendered: np.ndarray,
    inputs: EvaluationInputs,
    truth: GroundTruth | None,
    note: str,
    body: BodyFit | None,
    others: Mapping[str, np.ndarray],
) -> Row:
    """Return a view's row: input, mask, fitted body, rendering, reference, error, and other renderings by caption,
    cropped to the person.

    Renderings are (H, W, 4), RGB over black and coverage; with body None no body is shown. A scored view is compared to
    the truth; a training view, or one without truth, to the photograph under its mask.
    """
    image = inputs.capture.image(view.camera, view.frame)
    mask, reference = _mask_and_reference(view, image, inputs, truth)
    covered = rendered[..., 3] > COVERED_LEVEL
    box = pictures.frame_person(covered if mask is None else covered | mask)
    camera = pictures.cropped_camera(inputs.capture.cameras[view.camera], box)
    cut_image, cut_rendered = pictures.crop(image, box), pictures.crop(rendered[..., :3], box)
    row = [("Input", cut_image)]
    if mask is not None:
        cut_mask = pictures.crop(mask.astype(np.uint8) * 255, box) > 127
        row.append(("Mask", pictures.show_mask(cut_image, cut_mask)))
    if body is not None:
        surface = Surface.of(pose_vertices(body.rig, *body.pose(view.frame)).numpy(), body.rig.faces.numpy())
        row.append(("Fitted body", pictures.overlay_surface(cut_image, surface, camera)))
    row.append(("Render", cut_rendered))
    if reference is not None:
        caption, cut_reference = reference[0], pictures.crop(reference[1], box)
        row += [(caption, cut_reference), ("Error", pictures.error_map(cut_rendered, cut_reference))]
    row += [(caption, pictures.crop(other[..., :3], box)) for caption, other in others.items()]
    return Row(f"Frame {view.frame}, camera {view.camera}", note, [captioned(*picture) for picture in row])


def _mask_and_reference(
    view: View, image: np.ndarray, inputs: EvaluationInputs, truth: GroundTruth | None
) -> tuple[np.ndarray | None, tuple[str, np.ndarray] | None]:
    """Return the mask (H, W) bool and the captioned image to compare with, each None if there is none."""
    if view.split != TRAINING_VIEW and truth is not None and truth.has_mask(view.camera, view.frame):
        picture, source = truth.on_black(view.camera, view.frame)
        caption = "Input × mask" if source == GIVEN_MASKED_IMAGE else "Ground truth"
        return truth.mask(view.camera, view.frame), (caption, picture)
    if (view.camera, view.frame) not in inputs.masks:
        return None, None
    mask = inputs.masks.get(view.camera, view.frame)
    return mask, ("Input × mask", image * mask[..., None])


def surface_row(frame: int, mesh: trimesh.Trimesh, truth: trimesh.Trimesh | None, root: np.ndarray, note: str) -> Row:
    """Return a mesh's row: the mesh from the person's front and back, followed by the true mesh and the distance
    between them. root (4, 4)."""
    points_m = mesh.vertices if truth is None else np.concatenate([mesh.vertices, truth.vertices])
    ahead, up = root[:3, 1], root[:3, 2]  # the body faces -Y
    sides = {"front": ahead, "back": -ahead}
    cameras = {side: pictures.portrait_camera(points_m, towards, up) for side, towards in sides.items()}
    surface = Surface(mesh)
    shots = {side: pictures.shoot(surface, camera) for side, camera in cameras.items()}
    row = [(f"Surface, {side}", pictures.clay(shot)) for side, shot in shots.items()]
    if truth is not None:
        true_surface = Surface(truth)
        true_shots = {side: pictures.shoot(true_surface, camera) for side, camera in cameras.items()}
        row += [(f"Ground truth, {side}", pictures.clay(shot)) for side, shot in true_shots.items()]
        row += [(f"Distance, {side}", pictures.distance_map(shot, true_surface)) for side, shot in shots.items()]
    return Row(f"Frame {frame}", note, [captioned(*picture) for picture in row])


def captioned(caption: str, picture: np.ndarray) -> GalleryPicture:
    """Return an image (H, W, 3) uint8 with its caption."""
    return GalleryPicture(caption, pictures.data_uri(picture))
