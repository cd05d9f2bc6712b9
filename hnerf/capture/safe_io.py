"""Safe reading of untrusted files: inside the capture folder, no links, bounded sizes, no pickles."""

import json
import re
import tomllib
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from hnerf.errors import InputError

MAX_IMAGE_PIXELS = 64_000_000
MAX_TEXT_BYTES = 16_000_000
# Exceptions on reading arrays from a file that is not a complete .npz of plain arrays.
ARRAY_FILE_ERRORS = (
    AttributeError, EOFError, MemoryError, OSError, TypeError, ValueError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
VIDEO_SUFFIXES = (".mp4", ".mov")
JSON_SUFFIXES = (".json",)
_IMAGE_MODES = ("1", "L", "LA", "P", "RGB", "RGBA")  # 8 bits a channel: others would be clipped
_CAMERA_NAME = re.compile(r"\w([\w ()-]{0,62}[\w()-])?")  # is used as a folder name, and in a glob without wildcards
_ARGUMENTS = ("file", "allow_pickle")  # of np.savez, which is given keypoints with camera names as keywords


def check_camera_name(name: object, source: Path) -> str:
    """Return `name` if it can be the name of a folder and of an array in a .npz. Raises InputError naming `source`
    otherwise (separators, dots, wildcards)."""
    if not isinstance(name, str) or not _CAMERA_NAME.fullmatch(name):
        raise InputError(f"{source}: camera name {name!r}: use letters, digits, '_', '-', spaces and ()")
    if name in _ARGUMENTS:
        raise InputError(f"{source}: a camera cannot be called {name!r}; rename it")
    return name


def path_in_capture(root: Path, *parts: str) -> Path:
    """Return root/parts, which need not exist. Raises InputError if it leaves the capture folder or passes through a
    link."""
    path = root
    for part in parts:
        path = path / part
        if part in ("", ".", "..") or Path(part).name != part:
            raise InputError(f"{path}: the name leaves the capture folder; rename it")
        if path.is_symlink():
            raise InputError(f"{path}: is a symbolic link; put the file itself into the capture folder")
    return path


def files_in(root: Path, *parts: str, suffixes: tuple[str, ...] = ()) -> list[Path]:
    """Return the files of a folder inside the capture, sorted by name; an empty list if there is no such folder.
    suffixes: those to keep, in lower case, in whichever case files have them; none keeps all."""
    folder = path_in_capture(root, *parts)
    if not folder.is_dir():
        return []
    paths = (
        path_in_capture(root, *parts, found.name)
        for found in sorted(folder.iterdir())
        if not found.name.startswith(".")
    )
    return [path for path in paths if path.is_file() and (not suffixes or path.suffix.lower() in suffixes)]


def file_named(root: Path, stem: str, *parts: str, suffixes: tuple[str, ...]) -> Path:
    """Return the file called `stem` with one of these suffixes, matched as in `files_in`, in a folder inside the
    capture; where there is none, the path that it would have with the first suffix."""
    found = [path for path in files_in(root, *parts, suffixes=suffixes) if path.stem == stem]
    return found[0] if found else path_in_capture(root, *parts, stem + suffixes[0])


def numbered(paths: list[Path], what: str) -> dict[int, Path]:
    """Return files by the frame number that their name starts with. Raises InputError on a name without a number, or if
    two files have the same."""
    by_frame: dict[int, Path] = {}
    for path in paths:
        found = re.fullmatch(r"([0-9]{1,9})(?:_keypoints)?", path.stem)
        if not found:
            raise InputError(f"{path}: {what} are named by frame, like 000000{path.suffix}; rename or remove it")
        frame = int(found[1])
        if frame in by_frame:
            raise InputError(f"{path}: frame {frame} is also {by_frame[frame].name}; keep one of them")
        by_frame[frame] = path
    return by_frame


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Read a file's content. Raises InputError if it is missing or too large."""
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise InputError(f"{path}: {size} bytes are too many for such a file; export it again")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); add it to the capture folder") from None


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a small UTF-8 text file, with or without a byte order mark. Raises InputError if it is missing, empty, too
    large, or not text (a pickle, an archive)."""
    try:
        text = read_bytes(path, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text (a pickle, or another encoding?); save it as UTF-8") from None
    if not text.strip():
        raise InputError(f"{path}: is empty; export it again")
    return text


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises InputError as `read_text` does, or if it is not JSON."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error}); export it again") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises InputError as `read_text` does, or if it is not TOML."""
    try:
        return tomllib.loads(read_text(path))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is not TOML ({error}); correct it") from None


def check_image_size(path: Path, width_px: float, height_px: float) -> tuple[int, int]:
    """Return the declared (width, height) if sane, before anything is allocated for it. Raises InputError otherwise."""
    if not (width_px >= 1 and height_px >= 1 and width_px * height_px <= MAX_IMAGE_PIXELS):
        limit = MAX_IMAGE_PIXELS // 1_000_000
        raise InputError(f"{path}: declares {width_px:g} x {height_px:g} px; give 1 to {limit} million pixels")
    return int(width_px), int(height_px)


def read_image(path: Path) -> np.ndarray:
    """Read an image, upright, as (H, W, 3) uint8 RGB. Raises InputError if it is not a whole 8-bit JPEG or PNG of a
    sane size."""
    try:
        with Image.open(path, formats=["JPEG", "PNG"]) as image:
            check_image_size(path, *image.size)
            if image.mode not in _IMAGE_MODES:
                raise InputError(f"{path}: pixels are {image.mode}; export it again with 8 bits a channel")
            return np.array(ImageOps.exif_transpose(image).convert("RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise InputError(f"{path}: not a readable image ({reason}); export it again as JPEG or PNG") from None
