"""COLMAP models, `sparse/0/{cameras,images}.{bin,txt}`: world to camera, pixel centres at half-integers.

Images and everything else are laid out as in the EasyMocap layout; a model's image `01.jpg` or `01/000000.jpg` is
camera `01`. COLMAP's own reader trusts the counts in a binary file and can fill the memory; it accepts some truncated
files and never returns from others. So files are parsed here.
"""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.lens import MAX_SKEW_PX, Lens, checked_lens, known_size
from hnerf.capture.safe_io import check_camera_name, path_in_capture, read_bytes, read_text
from hnerf.errors import InputError
from hnerf.pycolmap_import import pycolmap

PIXEL_CENTRE = 0.5  # in COLMAP; here pixel centres have integer coordinates
MAX_BYTES = 256_000_000
POINT_BYTES = 24  # x, y, number of the 3-D point

# COLMAP's src/colmap/sensor/models.h: a model's number in binary files, and the positions of its parameters among fx fy
# cx cy k1 k2 p1 p2 k3 k4 k5 k6, for fisheyes fx fy cx cy k1 k2 k3 k4 (a single focal length is both fx and fy).
FX_FY = (0, 1)
MODELS: dict[str, tuple[int, tuple[tuple[int, ...], ...]]] = {
    "SIMPLE_PINHOLE": (0, (FX_FY, (2,), (3,))),
    "PINHOLE": (1, ((0,), (1,), (2,), (3,))),
    "SIMPLE_RADIAL": (2, (FX_FY, (2,), (3,), (4,))),
    "RADIAL": (3, (FX_FY, (2,), (3,), (4,), (5,))),
    "OPENCV": (4, ((0,), (1,), (2,), (3,), (4,), (5,), (6,), (7,))),
    "OPENCV_FISHEYE": (5, tuple((i,) for i in range(8))),
    "FULL_OPENCV": (6, tuple((i,) for i in range(12))),
    "SIMPLE_RADIAL_FISHEYE": (8, (FX_FY, (2,), (3,), (4,))),
    "RADIAL_FISHEYE": (9, (FX_FY, (2,), (3,), (4,), (5,))),
}
MODEL_NAMES = {number: name for name, (number, _) in MODELS.items()}
Parsed = TypeVar("Parsed")


class _Shot(NamedTuple):
    """One image of a model: quaternion w x y z and translation, world to camera."""

    name: str
    pose: tuple[float, ...]
    camera_id: int


class _Optics(NamedTuple):
    """One camera of a model: its intrinsics fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6, or fx fy cx cy k1 k2 k3 k4."""

    size_px: tuple[int, int]
    values: np.ndarray
    fisheye: bool


class Colmap(EasyMocap):
    """A capture folder with a COLMAP model in sparse/0 (or sparse/); its unit of length is arbitrary."""

    mark = "sparse/"

    def lenses(self) -> dict[str, Lens]:
        """Return one camera for each image of the model."""
        cameras, images = _model_file(self.folder, "cameras"), _model_file(self.folder, "images")
        optics_of = _parsed(cameras, {".bin": _optics_from_binary, ".txt": _optics_from_text})
        shots = _parsed(images, {".bin": _shots_from_binary, ".txt": _shots_from_text})
        lenses: dict[str, Lens] = {}
        for shot in shots:
            if shot.camera_id not in optics_of:
                raise InputError(
                    f"{images}: image {shot.name[:80]}: camera {shot.camera_id} is not in {cameras}; export both again"
                )
            lens = _lens((cameras, images), shot, optics_of[shot.camera_id])
            if lens.name in lenses:
                raise InputError(f"{images}: several images of camera {lens.name}; keep the images of one moment")
            lenses[lens.name] = lens
        if not lenses:
            raise InputError(f"{images}: holds no image; reconstruct again")
        return lenses


def write_colmap(out: Path, lenses: Sequence[Lens]) -> None:
    """Write `sparse/0` as text, with an image `<camera>/000000.jpg` for each camera and no points. Raises InputError on
    a lens without size, or with skew, which COLMAP's models lack."""
    model = pycolmap.Reconstruction()
    for number, lens in enumerate(lenses, start=1):
        name, parameters = _colmap_parameters(lens)
        width_px, height_px = known_size(lens)
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=name, width=width_px, height=height_px, params=parameters)
        )
        image = pycolmap.Image(f"{lens.name}/000000.jpg", np.zeros((0, 2)), number, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(lens.R), lens.t_m))
    folder = out / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    model.write_text(str(folder))
    if not all(path.read_bytes().endswith(b"\n") for path in folder.glob("*.txt")):  # which pycolmap does not check
        raise OSError(f"{folder}: cannot be written; is the disk full?")


def _colmap_parameters(lens: Lens) -> tuple[str, list[float]]:
    """Return the simplest model that can express the lens, and its parameters."""
    K, distortion = lens.K, lens.distortion.tolist()
    if abs(K[0, 1]) > MAX_SKEW_PX:
        raise InputError(f"camera {lens.name}: has skew, which COLMAP's models lack; export another format")
    linear = [K[0, 0], K[1, 1], K[0, 2] + PIXEL_CENTRE, K[1, 2] + PIXEL_CENTRE]
    if lens.fisheye:
        return "OPENCV_FISHEYE", linear + distortion
    if not any(distortion):
        return "PINHOLE", linear
    if not any(distortion[4:]):
        return "OPENCV", linear + distortion[:4]
    return "FULL_OPENCV", [*linear, *distortion, *[0.0] * (8 - len(distortion))]


def _lens(sources: tuple[Path, Path], shot: _Shot, optics: _Optics) -> Lens:
    """Return the lens of one image. Raises InputError if its camera cannot be used."""
    fx, fy, cx, cy = optics.values[:4]
    coefficients = 4 if optics.fisheye else 8 if optics.values[9:].any() else 5
    quaternion = np.array(shot.pose[:4])
    norm = np.linalg.norm(quaternion)
    if not 0.5 < norm < 2:
        raise InputError(f"{sources[1]}: image {shot.name[:80]}: its quaternion is not of length 1; reconstruct")
    return checked_lens(
        source=sources[0],
        name=check_camera_name(PurePosixPath(shot.name.split("/")[0]).stem, sources[1]),
        K=np.array([[fx, 0, cx - PIXEL_CENTRE], [0, fy, cy - PIXEL_CENTRE], [0, 0, 1]]),
        distortion=optics.values[4 : 4 + coefficients],
        R=Rotation.from_quat(quaternion / norm, scalar_first=True).as_matrix(),
        t_m=np.array(shot.pose[4:]),
        size_px=optics.size_px,
        extrinsics=sources[1],
        fisheye=optics.fisheye,
    )


def _model_file(folder: Path, stem: str) -> Path:
    """Return the binary file, else the text file, in sparse/0, else in sparse. Raises InputError if there is none."""
    for parts in (("sparse", "0"), ("sparse",)):
        for suffix in (".bin", ".txt"):
            path = path_in_capture(folder, *parts, stem + suffix)
            if path.is_file():
                return path
    raise InputError(f"{folder / 'sparse' / '0'}: no {stem}.bin or {stem}.txt; export the model again")


def _parsed(path: Path, parsers: dict[str, Callable[[Path], Parsed]]) -> Parsed:
    """Parse a file by its suffix. Raises InputError if that fails."""
    try:
        return parsers[path.suffix](path)
    except (IndexError, KeyError, OverflowError, TypeError, ValueError, struct.error):
        known = ", ".join(MODELS)
        raise InputError(f"{path}: not a COLMAP model, or of other cameras than {known}; export it again") from None


def _optics_from_text(path: Path) -> dict[int, _Optics]:
    """Parse lines of CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]."""
    rows = [line.split() for line in _lines(path) if line]
    return {
        int(number): _optics(model, int(width_px), int(height_px), tuple(map(float, parameters)))
        for number, model, width_px, height_px, *parameters in rows
    }


def _shots_from_text(path: Path) -> list[_Shot]:
    """Parse pairs of lines: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its points, which may be none."""
    shots = []
    for line in _lines(path)[::2]:
        _, *pose, camera_id, name = line.split(maxsplit=9)
        if len(pose) != 7:
            raise ValueError(line)
        shots.append(_Shot(name, tuple(map(float, pose)), int(camera_id)))
    return shots


def _lines(path: Path) -> list[str]:
    """Return the lines that are not comments, without trailing blank ones."""
    text = read_text(path, MAX_BYTES)
    return [line.strip() for line in text.rstrip().split("\n") if not line.startswith("#")]


def _optics_from_binary(path: Path) -> dict[int, _Optics]:
    """Parse a uint64 count, then for each camera int32 id, int32 model, uint64 width, uint64 height, its parameters in
    double."""
    data = read_bytes(path, MAX_BYTES)
    (count,), at = struct.unpack_from("<Q", data), 8
    found: dict[int, _Optics] = {}
    for _ in range(count):
        camera_id, number, width_px, height_px = struct.unpack_from("<iiQQ", data, at)
        places = MODELS[MODEL_NAMES[number]][1]
        found[camera_id] = _optics(
            MODEL_NAMES[number], width_px, height_px, struct.unpack_from(f"<{len(places)}d", data, at + 24)
        )
        at += 24 + 8 * len(places)
    return found


def _shots_from_binary(path: Path) -> list[_Shot]:
    """Parse a uint64 count, then for each image uint32 id, quaternion and translation in double, uint32 camera, its
    name ending in 0, uint64 number of points, the points."""
    data = read_bytes(path, MAX_BYTES)
    (count,), at = struct.unpack_from("<Q", data), 8
    shots = []
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        shots.append(_Shot(data[at + 64 : end].decode(), tuple(pose), camera_id))
        at = end + 9 + POINT_BYTES * points
    return shots


def _optics(model: str, width_px: int, height_px: int, parameters: tuple[float, ...]) -> _Optics:
    """Return a camera of the model. Raises ValueError if its number of parameters is wrong."""
    values = np.zeros(12)
    for value, place in zip(parameters, MODELS[model][1], strict=True):
        values[list(place)] = value
    return _Optics((width_px, height_px), values, model.endswith("FISHEYE"))
