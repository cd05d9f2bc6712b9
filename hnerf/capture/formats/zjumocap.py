"""ZJU-MoCap, and Human3.6M as NeuralBody prepares it: annots.npy, mask_cihp/ or mask/, new_params/ or params/."""

import re
import unicodedata
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from hnerf.capture.footage import Footage, ImageFolder
from hnerf.capture.formats.layout import Layout, StoredFrame, one_a_file
from hnerf.capture.given_poses import JOINTS, GivenPoses, check_smpl
from hnerf.capture.lens import Lens, checked_lens
from hnerf.capture.manifest import read_manifest
from hnerf.capture.safe_io import path_in_capture, read_mask, shown
from hnerf.capture.safe_pickle import read_pickled_npy
from hnerf.errors import InputError

# NeuralBody's configs train on these of ZJU-MoCap's 21 to 23 cameras, and on all but the last of Human3.6M's 4.
TRAINING_CAMERAS = {4: (0, 1, 2)} | dict.fromkeys((21, 22, 23), (0, 6, 12, 18))
METRES_PER_UNIT = 1e-3  # of the cameras' translations


@dataclass(frozen=True)
class ZjuMocap(Layout):
    """A capture folder as NeuralBody's own tools read it: world to camera, OpenCV axes, Z up."""

    mark = "annots.npy"

    @property
    def source(self) -> Path:
        """Return the file that lists cameras and images."""
        return path_in_capture(self.folder, "annots.npy")

    @cached_property
    def images(self) -> dict[str, dict[int, PurePosixPath]]:
        """Return image paths by camera and frame; a camera is named after the folder of its images."""
        try:
            rows = [[PurePosixPath(str(path)) for path in row["ims"]] for row in self._annotations["ims"]]
            names = [_camera(path) for path in rows[0]]
            frames = [_frame(row[0]) for row in rows]
            columns = list(zip(*rows, strict=True))
            strays = [
                path
                for frame, row in zip(frames, rows, strict=True)
                for name, path in zip(names, row, strict=True)
                if (_camera(path), _frame(path)) != (name, frame)
            ]
        except (IndexError, KeyError, TypeError, ValueError):
            raise InputError(
                f"{self.source}: 'ims' does not list images by frame number, equally many per frame; prepare it again"
            ) from None
        if strays:
            raise InputError(
                f"{self.source}: lists {shown(str(strays[0]))} where another camera or frame belongs; prepare it again"
            )
        if len(set(names)) < len(names) or len(set(frames)) < len(frames):
            raise InputError(f"{self.source}: lists two images of one camera and frame; prepare it again")
        return {name: dict(zip(frames, paths, strict=True)) for name, paths in zip(names, columns, strict=True)}

    @cached_property
    def _annotations(self) -> Any:
        """Read the content of annots.npy."""
        return read_pickled_npy(self.source)

    def lenses(self) -> dict[str, Lens]:
        """Return one camera for each image of a frame. Raises InputError if capture.toml converts them once more."""
        if read_manifest(self.folder).metres_per_unit == METRES_PER_UNIT:
            raise InputError(
                f"{self.folder / 'capture.toml'}: units: translations in annots.npy count as millimetres anyway; "
                "remove the line"
            )
        lenses = {}
        for i, name in enumerate(self.images):
            try:
                cameras = self._annotations["cams"]
                K, D, R, T = (np.asarray(cameras[key][i], dtype=np.float64) for key in "KDRT")
            except (IndexError, KeyError, OverflowError, TypeError, ValueError):
                raise InputError(
                    f"{self.source}: camera {name[:80]}: K, D, R or T is missing; prepare it again"
                ) from None
            lens = checked_lens(self.source, name, K, D, R, T * METRES_PER_UNIT, None)
            lenses[lens.name] = lens
        return lenses

    def training_cameras(self) -> list[str]:
        """Return the cameras that NeuralBody trains on."""
        names = list(self.images)
        return [names[i] for i in TRAINING_CAMERAS.get(len(names), ())]

    def footage(self, camera: str) -> Footage:
        """Return the images that annots.npy lists."""
        files = {frame: path_in_capture(self.folder, *path.parts) for frame, path in self.images[camera].items()}
        return ImageFolder(next(iter(files.values())).parent, files)

    def mask_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return mask_cihp/<image>.png, or mask/, by frame: part labels, 0 outside the person. A camera may have
        none."""
        images = {frame: path.with_suffix(".png").parts for frame, path in self.images[camera].items()}
        for name in ("mask_cihp", "mask"):
            masks = {frame: path_in_capture(self.folder, name, *parts) for frame, parts in images.items()}
            if any(path.exists() for path in masks.values()):
                return one_a_file(masks, read_mask)
        return {}

    def given_poses(self, frames: tuple[int, ...]) -> GivenPoses | None:
        """Return the poses of new_params/<frame>.npy, or params/: SMPL's poses (72, of which the first 3 are zero, or
        69), Rh, Th, shapes; a vertex is R(Rh) SMPL(poses, shapes) + Th."""
        folders = [name for name in ("new_params", "params") if path_in_capture(self.folder, name).is_dir()]
        if not folders:
            return None
        poses = GivenPoses.unknown(len(frames))
        betas = []
        for i, frame in enumerate(frames):
            path = path_in_capture(self.folder, folders[0], f"{frame}.npy")
            if path.exists():
                turns, poses.root[i], shape = _parameters(path)
                poses.theta[i].flat[-len(turns) :] = turns
                poses.theta[i, 0] = np.nan_to_num(poses.theta[i, 0])  # the 69 leave out the pelvis
                betas.append(shape)
        poses.betas[:] = np.mean(betas, 0) if betas else 0
        return poses


def _camera(path: PurePosixPath) -> str:
    """Return the name of the camera of an image."""
    return unicodedata.normalize("NFC", path.parent.name)


def _frame(path: PurePosixPath) -> int:
    """Return the frame number of an image: 000012.jpg is frame 12, and so is
    CoreView_313_Camera_(1)_0012_2019-08-23_16-08-50.592.jpg. Raises IndexError or ValueError on other names."""
    number = path.stem if path.stem.isdigit() else path.stem.split("_")[4]
    if not re.fullmatch("[0-9]{1,9}", number):
        raise ValueError(number)
    return int(number)


def _parameters(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read the parameters of one frame: turns (72,) or (69,), placement (4, 4) in metres, shape (10,)."""
    try:
        stored = read_pickled_npy(path)
        turns, rotation, translation, shape = (
            np.asarray(stored[key], dtype=np.float64).ravel() for key in ("poses", "Rh", "Th", "shapes")
        )
        placed = np.eye(4)
        placed[:3, :3], placed[:3, 3] = cv2.Rodrigues(rotation)[0], translation
    except (IndexError, KeyError, OverflowError, TypeError, ValueError, cv2.error):
        raise InputError(f"{path}: no poses, Rh, Th and shapes of SMPL; remove it or fit again") from None
    if len(turns) not in (3 * JOINTS, 3 * JOINTS - 3) or len(shape) < 10:
        raise InputError(f"{path}: {len(turns)} turns and {len(shape)} shape values are not SMPL's; remove it")
    check_smpl(path, np.concatenate([turns, rotation]), translation, shape[:10])
    return turns, placed, shape[:10]
