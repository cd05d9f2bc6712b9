"""The EasyMocap layout: intri.yml and extri.yml, images/ or videos/, openpose/ or pose/, masks/ or mask/,
background/."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture import safe_io
from hnerf.capture.footage import Footage, ImageFolder, Video
from hnerf.capture.formats.layout import Layout, StoredFrame, one_a_file
from hnerf.capture.keypoint_files import read_openpose
from hnerf.capture.lens import Lens, by_name, checked_lens
from hnerf.errors import InputError
from hnerf.strict_yaml import parse_yaml_strings

MAX_CALIBRATION_BYTES = 500_000


@dataclass(frozen=True)
class EasyMocap(Layout):
    """A capture folder as EasyMocap's own tools read it (its `read_camera`): world to camera, OpenCV axes."""

    mark = "extri.yml"

    def lenses(self) -> dict[str, Lens]:
        """Return every camera that intri.yml names."""
        return _lenses(self.folder, ("R", "Rot"))

    def footage(self, camera: str) -> Footage:
        """Return images/<camera>/, else videos/<camera>.mp4, else <camera>.mp4."""
        if images := self._images(camera):
            return ImageFolder(self.folder / "images" / camera, images)
        video = safe_io.file_named(self.folder, camera, "videos", suffixes=safe_io.VIDEO_SUFFIXES)
        beside = safe_io.file_named(self.folder, camera, suffixes=safe_io.VIDEO_SUFFIXES)
        for found in (video, beside):
            if found.exists():
                return Video.open(found)
        raise InputError(
            f"{self.folder / 'images' / camera}: no JPEG or PNG images, and no {video}; "
            "add them, or leave the camera out of [cameras] in capture.toml"
        )

    def keypoint_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return openpose/<camera>/<frame>_keypoints.json by frame, else Pose2Sim's pose/<camera>_json/*.json, one for
        each frame, in the order of the numbers in their names (walk_9 before walk_10)."""
        if own := safe_io.files_in(self.folder, "openpose", camera, suffixes=safe_io.JSON_SUFFIXES):
            return one_a_file(safe_io.numbered(own, "keypoints"), read_openpose)
        found = safe_io.files_in(self.folder, "pose", f"{camera}_json", suffixes=safe_io.JSON_SUFFIXES)
        images = sorted(self._images(camera))
        numbers = images if len(images) == len(found) else range(len(found))
        return one_a_file(dict(zip(numbers, sorted(found, key=_natural_order), strict=True)), read_openpose)

    def _images(self, camera: str) -> dict[int, Path]:
        files = safe_io.files_in(self.folder, "images", camera, suffixes=safe_io.IMAGE_SUFFIXES)
        return safe_io.numbered(files, "images")

    def mask_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return masks/<camera>/<frame>.png, or mask/, by frame."""
        for name in ("masks", "mask"):
            files = safe_io.files_in(self.folder, name, camera, suffixes=safe_io.IMAGE_SUFFIXES)
            if files:
                return one_a_file(safe_io.numbered(files, "masks"), safe_io.read_mask)
        return {}

    def plate_file(self, camera: str) -> Path | None:
        """Return background/<camera>.jpg or .png; raise InputError if that is a folder."""
        if (folder := safe_io.path_in_capture(self.folder, "background", camera)).is_dir():
            raise InputError(f"{folder}: a folder; give one clean plate a camera, as {folder.name}.png beside it")
        plate = safe_io.file_named(self.folder, camera, "background", suffixes=safe_io.IMAGE_SUFFIXES)
        return plate if plate.exists() else None


def _natural_order(path: Path) -> list[str | int]:
    """Return a key that sorts walk_9 before walk_10."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split("([0-9]+)", path.stem))]


def write_easymocap(out: Path, lenses: Sequence[Lens]) -> None:
    """Write `intri.yml` and `extri.yml`, as text: OpenCV's own writer refuses names like `Camera (1)`. Raises
    InputError on a fisheye, whose coefficients EasyMocap would take for k1 k2 p1 p2."""
    if fisheye := next((lens for lens in lenses if lens.fisheye), None):
        raise InputError(f"camera {fisheye.name}: is a fisheye, which intri.yml cannot express; export another format")
    names = "".join(f'   - "{lens.name}"\n' for lens in lenses)
    intri = extri = f"%YAML:1.0\n---\nnames:\n{names}"
    for lens in lenses:
        intri += _matrix(f"K_{lens.name}", lens.K) + _matrix(f"dist_{lens.name}", lens.distortion[None])
        if lens.size_px:
            intri += f"W_{lens.name}: {lens.size_px[0]}\nH_{lens.name}: {lens.size_px[1]}\n"
        if lens.estimated:
            intri += f"estimated_{lens.name}: 1\n"
        extri += _matrix(f"R_{lens.name}", cv2.Rodrigues(lens.R)[0]) + _matrix(f"Rot_{lens.name}", lens.R)
        extri += _matrix(f"T_{lens.name}", lens.t_m[:, None])
    (out / "intri.yml").write_text(intri, encoding="utf-8")
    (out / "extri.yml").write_text(extri, encoding="utf-8")


def read_easymocap(folder: Path) -> dict[str, Lens]:
    """Return the lenses that `write_easymocap` wrote, with the same rotations to the last digit. Raises InputError if
    they are not valid."""
    return _lenses(folder, ("Rot",))


def _matrix(key: str, values: np.ndarray) -> str:
    """Return a matrix in OpenCV's YAML."""
    rows, cols = values.shape
    data = values.astype(np.float64).ravel().tolist()
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {data}\n"


def read_intrinsics(path: Path) -> dict[str, Lens]:
    """Return the lenses of an `intri.yml`, at the origin."""
    intri = _CalibrationFile(path)
    if not any(f"K_{name}" in intri.tree for name in intri.names()):  # an extri.yml
        raise InputError(f"{path}: has no intrinsics (K_<camera>); give an intri.yml")
    return {name: _lens(name, intri, None) for name in intri.names()}


class _CalibrationFile:
    """An OpenCV FileStorage in YAML.

    All values are read as strings: OpenCV's own parser overflows the stack on deep nesting, and allocates whatever
    matrix a file declares.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        # OpenCV's header is not valid YAML.
        text = re.sub(r"\A%YAML:\S*", "", safe_io.read_text(path, MAX_CALIBRATION_BYTES))
        try:
            self.tree = parse_yaml_strings(text)
        except ValueError as error:
            why = " ".join(str(error).split())
            raise InputError(f"{path}: not an OpenCV YAML file ({why}); export it again with EasyMocap") from None
        if not isinstance(self.tree, dict):
            raise InputError(f"{path}: not an OpenCV YAML file; export it again with EasyMocap")

    def names(self) -> list[str]:
        """Return the names of the cameras. Raises InputError if there are none, or if one cannot be a name."""
        names = self.tree.get("names")
        if not isinstance(names, list) or not names:
            raise InputError(f"{self.path}: lists no cameras under 'names'; export it again with EasyMocap")
        return [safe_io.check_camera_name(name, self.path) for name in names]

    def number(self, key: str) -> float | None:
        """Return a number, or None if the key is missing. Raises InputError if the value is not a number."""
        try:
            return float(self.tree[key]) if key in self.tree else None
        except (TypeError, ValueError):
            raise InputError(f"{self.path}: {key} is not a number; calibrate again") from None

    def matrix(self, *keys: str) -> np.ndarray | None:
        """Return the first of these keys that exists, as float64; None if none does."""
        found = [key for key in keys if key in self.tree]
        if not found:
            return None
        try:
            node = self.tree[found[0]]
            return np.array([float(value) for value in node["data"]]).reshape(int(node["rows"]), int(node["cols"]))
        except (KeyError, OverflowError, TypeError, ValueError):
            raise InputError(f"{self.path}: {found[0]} is not a matrix of finite numbers; calibrate again") from None

    def required(self, *keys: str) -> np.ndarray:
        """Return the first of these keys that exists, as float64. Raises InputError if none does."""
        found = self.matrix(*keys)
        if found is None:
            raise InputError(f"{self.path}: {' or '.join(keys)} is missing; calibrate that camera, or take it out")
        return found


def _lenses(folder: Path, rotations: tuple[str, ...]) -> dict[str, Lens]:
    """Return every camera that intri.yml names. rotations: as in `_lens`."""
    intri = _CalibrationFile(safe_io.path_in_capture(folder, "intri.yml"))
    extri = _CalibrationFile(safe_io.path_in_capture(folder, "extri.yml"))
    return by_name((_lens(name, intri, extri, rotations) for name in intri.names()), intri.path)


def _lens(name: str, intri: _CalibrationFile, extri: _CalibrationFile | None, rotations: tuple[str, ...] = ()) -> Lens:
    """Return the lens of one camera; at the origin without a file of extrinsics. rotations: prefixes of the rotation's
    key there, of which the first that exists is used."""
    distortion = intri.matrix(f"dist_{name}", f"D_{name}")
    width_px, height_px = sides = intri.number(f"W_{name}"), intri.number(f"H_{name}")
    if sides.count(None) == 1:
        raise InputError(f"{intri.path}: has one of W_{name} and H_{name}; add the other, or remove this one")
    return checked_lens(
        source=intri.path,
        name=name,
        K=intri.required(f"K_{name}"),
        distortion=np.zeros(4) if distortion is None else distortion,
        R=extri.required(*(f"{kind}_{name}" for kind in rotations)) if extri else np.eye(3),
        t_m=extri.required(f"T_{name}") if extri else np.zeros(3),
        size_px=(width_px, height_px) if width_px is not None and height_px is not None else None,
        estimated=intri.number(f"estimated_{name}") == 1,
        extrinsics=extri.path if extri else None,
    )
