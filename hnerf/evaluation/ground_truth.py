"""What images and surfaces are scored against: the ground truth of a capture folder (masks, the person on black, and
surfaces, under `ground_truth/`), or its own masks."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import trimesh

from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.capture.normalise import Normaliser
from hnerf.capture.safe_io import ARRAY_FILE_ERRORS, path_in_capture, read_arrays, read_image
from hnerf.errors import InputError, raise_if_unreachable

ON_BLACK = "ground_truth/on_black"
MAX_MESHES_BYTES = 2_000_000_000  # unpacked; 60 frames of a million vertices have 1.4 GB
MAX_M = 10_000  # from the origin, of true surfaces
MASKED_IMAGE = "image x ground-truth mask"
GIVEN_MASKED_IMAGE = "photograph x given mask"
UNDER_GIVEN_MASKS = "photographs under the masks that came with the recording, whose errors count as the field's"


@dataclass(frozen=True)
class GroundTruth:
    """The ground truth in an original capture folder, under `ground_truth/`. Images are those of the recorded frame
    nearest in time, as in the capture, at the size of its camera."""

    folder: Path
    capture: Capture

    @property
    def has_masks(self) -> bool:
        """Return whether any test camera has masks."""
        return any(self.has_mask(c, f) for c in self.capture.test_cameras for f in self.capture.frames)

    def has_mask(self, camera: str, frame: int) -> bool:
        """Return whether this image has a true mask: there may be only a few, drawn by hand."""
        return self._mask_path(camera, frame).exists()

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """Return the true mask, (H, W) bool, True on the person."""
        path = self._mask_path(camera, frame)
        return self._as_rendered(read_image(path)[..., 0], camera, path) > 127

    def on_black(self, camera: str, frame: int) -> tuple[np.ndarray, str]:
        """Return the person alone over black, (H, W, 3) uint8, and the name of its source.

        The source is `on_black/`, whose edge pixels are weighted by coverage, if it has the view; else the photograph
        times the mask.
        """
        path = self._path("on_black", camera, f"{self.capture.recorded_frame(camera, frame):06d}.jpg")
        if path.exists():
            return self._as_rendered(read_image(path), camera, path), ON_BLACK
        return self.capture.image(camera, frame) * self.mask(camera, frame)[..., None], MASKED_IMAGE

    def meshes(self) -> dict[int, trimesh.Trimesh]:
        """Return the true surface, in world metres, of every frame that has one."""
        path = self._path("meshes.npz")
        if not path.exists():
            return {}
        try:
            stored = read_arrays(path, ("faces", "vertices", "frames"), MAX_MESHES_BYTES)
            faces, vertices, frames = stored["faces"], stored["vertices"], stored["frames"]
            if vertices.shape[2:] != (3,) or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
                raise ValueError("vertices are not (frames, V, 3), or faces not integers (F, 3)")
            near = vertices.min() >= -MAX_M and vertices.max() <= MAX_M  # False for NaN
            if not (near and faces.min() >= 0 and faces.max() < vertices.shape[1]):
                raise ValueError(f"a face index is out of range, or a vertex is not within {MAX_M} m")
            return {int(f): trimesh.Trimesh(v, faces, process=False) for f, v in zip(frames, vertices, strict=True)}
        except (*ARRAY_FILE_ERRORS, IndexError) as error:
            raise_if_unreachable(error)
            raise InputError(
                f"{path}: true surfaces cannot be read ({error}); write the file again or delete it"
            ) from None

    def _path(self, *parts: str) -> Path:
        return path_in_capture(self.folder, "ground_truth", *parts)

    def _mask_path(self, camera: str, frame: int) -> Path:
        return self._path("masks", camera, f"{self.capture.recorded_frame(camera, frame):06d}.png")

    def _as_rendered(self, image: np.ndarray, camera: str, path: Path) -> np.ndarray:
        """Undistort and shrink an image of the recording's size, as ingest does with photographs; return an image of
        the camera's size unchanged. If no lens distorts, an image of another size but the same aspect ratio is resized.
        Raises InputError otherwise."""
        size = self.capture.cameras[camera].size_px
        recorded_px = self.capture.recorded_sizes_px.get(camera)
        lens = self.capture.recorded_lens(camera)
        if lens and image.shape[1::-1] == recorded_px:
            return Normaliser.create(lens, recorded_px, max(size)).pixels(image)
        width_px, height_px = given = image.shape[1::-1]
        if given == size:
            return image
        stretched = abs(width_px * size[1] - height_px * size[0]) > max(given)  # by more than rounding
        if lens or (stretched and given != recorded_px):
            raise InputError(
                f"{path}: is {width_px} x {height_px} px, unlike camera {camera}; give it at the recording's size"
            )
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


class GivenMasks(GroundTruth):
    """What stands in for the ground truth if the test cameras have no true masks, but masks that came with the
    recording: photographs under those masks, with everybody they show. Surfaces are still those of `ground_truth/`."""

    def has_mask(self, camera: str, frame: int) -> bool:
        """Return whether a mask of this image came with the recording."""
        return self.capture.has_given_mask(camera, frame)

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """Return the given mask, (H, W) bool, True on the person."""
        mask = self.capture.given_mask(camera, frame)
        assert mask is not None  # by has_mask
        return mask

    def on_black(self, camera: str, frame: int) -> tuple[np.ndarray, str]:
        """Return the photograph under its mask, (H, W, 3) uint8, and the name of that source."""
        return self.capture.image(camera, frame) * self.mask(camera, frame)[..., None], GIVEN_MASKED_IMAGE


def truth_of(folder: Path, capture: Capture) -> GroundTruth:
    """Return what a capture with an original folder is scored against: GivenMasks only if its test cameras have no true
    masks."""
    truth, given = GroundTruth(folder, capture), GivenMasks(folder, capture)
    return given if not truth.has_masks and given.has_masks else truth


@dataclass(frozen=True)
class OwnMasks:
    """What stands in for ground truth in captures without any: the person under the masks from segmentation."""

    capture: Capture
    masks: Masks
    has_masks: ClassVar[bool] = True

    def has_mask(self, camera: str, frame: int) -> bool:
        """Return whether this image has a mask that can be trusted."""
        return (camera, frame) in self.masks

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """Return the mask, (H, W) bool, True on the person."""
        return self.masks.get(camera, frame)

    def on_black(self, camera: str, frame: int) -> tuple[np.ndarray, str]:
        """Return the photograph under its mask, (H, W, 3) uint8, and the name of that source."""
        return self.capture.image(camera, frame) * self.mask(camera, frame)[..., None], "photograph x own mask"


Truth = GroundTruth | OwnMasks  # what images are scored against
