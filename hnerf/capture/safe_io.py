"""Safe reading of untrusted files: inside the capture folder, no links, pipes or devices, bounded sizes, no pickles."""

import json
import os
import re
import stat
import tokenize
import tomllib
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hnerf.errors import InputError, one_line, raise_if_unreachable

MAX_IMAGE_PIXELS = 36_000_000  # a frame of 8K video has 33 million
MAX_SIDE_PX = 32_766  # of images that OpenCV can undistort
MAX_IMAGE_BYTES = 300_000_000  # those pixels take 288 uncompressed, at 16 bits a channel; anything may follow an image
MAX_TEXT_BYTES = 16_000_000
MAX_TOML_BYTES = 500_000
MAX_KEY_PARTS = 16  # of a dotted key in TOML; tomllib's memory and time grow with their square
# Exceptions on reading arrays from a file that is not a complete .npz of plain arrays; RuntimeError: an encrypted one,
# or an unknown compression; OverflowError: a shape beyond all integers; tokenize.TokenError: a header with an open
# bracket.
ARRAY_FILE_ERRORS = (
    AttributeError, EOFError, KeyError, MemoryError, OSError, OverflowError, RuntimeError, SyntaxError, TypeError,
    ValueError, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
VIDEO_SUFFIXES = (".mp4", ".mov")
JSON_SUFFIXES = (".json",)
_IMAGE_MODES = ("1", "L", "LA", "P", "RGB", "RGBA")  # 8 bits a channel: others would be clipped
_EXIF_ORIENTATION = 0x112
_UPRIGHT = dict(enumerate(  # by EXIF orientation, 2 to 8: the operation that turns the image upright
    (Image.Transpose.FLIP_LEFT_RIGHT, Image.Transpose.ROTATE_180, Image.Transpose.FLIP_TOP_BOTTOM,
     Image.Transpose.TRANSPOSE, Image.Transpose.ROTATE_270, Image.Transpose.TRANSVERSE, Image.Transpose.ROTATE_90), 2
))  # fmt: skip
_CAMERA_NAME = re.compile(r"\w([\w ()-]{0,62}[\w()-])?")  # is used as a folder name, and in a glob without wildcards
_FRAME_NAME = re.compile(r"0*([0-9]{1,9})|(?:.*_)?0*([0-9]{1,9})_keypoints")
_KEY_PART = r"""(?:(?<![\w-])[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"{_KEY_PART}(?:[ \t]*\.[ \t]*{_KEY_PART}){{{MAX_KEY_PARTS}}}")
_ARGUMENTS = ("file", "allow_pickle")  # of np.savez, to which keypoints are passed with camera names as keywords


def check_camera_name(name: object, source: Path) -> str:
    """Return `name`, its accents composed, if it can be the name of a folder and of an array in a .npz. Raises
    InputError naming `source` otherwise (separators, dots, wildcards)."""
    composed = _composed(name) if isinstance(name, str) else ""
    if not _CAMERA_NAME.fullmatch(composed):
        raise InputError(
            f"{source}: camera name {shown(name)}: rename it; use letters, digits, '_', '-', spaces and ()"
        )
    if composed in _ARGUMENTS:
        raise InputError(f"{source}: a camera cannot be called {name!r}; rename it")
    return composed


def _composed(text: str) -> str:
    """Return a text with each accented letter as one character; macOS uses two in file names."""
    return unicodedata.normalize("NFC", text)


def shown(value: object) -> str:
    """Return an untrusted file's value as a message quotes it: text is truncated, anything else is not shown."""
    return f"{value[:80]!r}{'...' if len(value) > 80 else ''}" if isinstance(value, str) else "that is no text"


def path_in_capture(root: Path, *parts: str) -> Path:
    """Return root/parts, which need not exist, with accents as the folder spells them. Raises InputError if it leaves
    the capture folder, passes through a link, or is a pipe or a device, which could block forever."""
    path = root
    for part in parts:
        path = path / _spelled(path, part)
        if part in ("", ".", "..") or Path(part).name != part:
            raise InputError(f"{path}: the name leaves the capture folder; rename it")
        try:
            mode = path.lstat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            continue
        except (OSError, ValueError) as error:  # a name that is too long or holds a NUL; a folder that may not be read
            raise_if_unreachable(error)
            raise InputError(f"{path}: cannot be read ({error}); rename it or make it readable") from None
        if stat.S_ISLNK(mode):
            raise InputError(f"{path}: is a symbolic link; put the file itself into the capture folder")
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise InputError(f"{path}: is a pipe or a device; put a file into the capture folder")
    return path


def _spelled(folder: Path, name: str) -> str:
    """Return the name of a file, whose accents may be composed or not, as the folder that holds it spells it."""
    if name.isascii() or os.path.lexists(folder / name) or not folder.is_dir():
        return name
    return next((other for other in os.listdir(folder) if _composed(other) == _composed(name)), name)


def files_in(root: Path, *parts: str, suffixes: tuple[str, ...] = ()) -> list[Path]:
    """Return the files of a folder inside the capture, sorted by name; an empty list if there is no such folder.
    suffixes: those to keep, in lower case, whatever their case in file names; empty keeps all. Raises InputError if a
    file is in the folder's place."""
    folder = path_in_capture(root, *parts)
    for place in (root.joinpath(*parts[:depth]) for depth in range(1, len(parts) + 1)):
        if place.is_file():
            raise InputError(f"{place}: is a file where a folder belongs; rename or remove it")
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
    capture; if there is none, the path that it would have with the first suffix. Raises InputError if there are
    several."""
    found = by_camera([path for path in files_in(root, *parts, suffixes=suffixes) if _composed(path.stem) == stem])
    return found.get(stem) or path_in_capture(root, *parts, stem + suffixes[0])


def by_camera(paths: list[Path]) -> dict[str, Path]:
    """Return files by the camera that they are named after. Raises InputError on a name that no camera can have, or if
    two files are named after one camera."""
    found: dict[str, Path] = {}
    for path in paths:
        name = check_camera_name(path.stem, path)
        if name in found:
            raise InputError(f"{path}: camera {name} is also {found[name].name}; keep one of them")
        found[name] = path
    return found


def numbered(paths: list[Path], what: str) -> dict[int, Path]:
    """Return files by frame number, which is their name or, as in OpenPose's file names, the part before `_keypoints`.
    Raises InputError on another name, or if two files have the same number."""
    by_frame: dict[int, Path] = {}
    for path in paths:
        found = _FRAME_NAME.fullmatch(path.stem)
        if not found:
            raise InputError(f"{path}: {what} are named by frame, like 000000{path.suffix}; rename or remove it")
        frame = int(found[1] or found[2])
        if frame in by_frame:
            raise InputError(f"{path}: frame {frame} is also {by_frame[frame].name}; keep one of them")
        by_frame[frame] = path
    return by_frame


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Read a regular file's content. Raises InputError if it is missing, too large, or a pipe or a device."""
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise InputError(f"{path}: is no regular file; put the file itself there")
            if status.st_size > max_bytes:
                raise InputError(f"{path}: {status.st_size} bytes are too many for such a file; export it again")
            return file.read(max_bytes)
    except OSError as error:
        raise_if_unreachable(error)
        raise InputError(f"{path}: cannot be read ({error.strerror}); add it to the capture folder") from None
    except ValueError:
        raise InputError(f"{path}: cannot be the name of a file; rename it") from None


def _without_waiting(name: str, flags: int) -> int:
    """Open a file without blocking, even a pipe without a writer."""
    return os.open(name, flags | os.O_NONBLOCK)


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a small UTF-8 text file, with or without a byte order mark; its accents are composed. Raises InputError if
    it is missing, empty, too large, or not text (a pickle, an archive)."""
    try:
        text = _composed(read_bytes(path, max_bytes).decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text (a pickle, or another encoding?); save it as UTF-8") from None
    if not text.strip():
        raise InputError(f"{path}: is empty; export it again")
    return text


def read_json(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Read a JSON file. Raises InputError as `read_text` does, or if it is not JSON."""
    try:
        return json.loads(read_text(path, max_bytes))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error}); export it again") from None


def read_toml(path: Path, max_bytes: int = MAX_TOML_BYTES) -> dict[str, Any]:
    """Read a TOML file. Raises InputError as `read_text` does, if it is not TOML, or if a key has too many parts."""
    text = read_text(path, max_bytes)
    if _DEEP_KEY.search(text):
        raise InputError(f"{path}: a key has more than {MAX_KEY_PARTS} parts; shorten it")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError: a date, or an integer of thousands of digits
        raise InputError(f"{path}: is not TOML ({error}); correct it") from None


def read_arrays(path: Path, wanted: Container[str], max_bytes: int) -> dict[str, np.ndarray]:
    """Read those of the wanted arrays that an .npz file has. Raises one of ARRAY_FILE_ERRORS if it is not an .npz of
    plain arrays, InputError if they unpack to more than `max_bytes`, as even a few kilobytes can."""
    with open(path, "rb", opener=_without_waiting) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise InputError(f"{path}: is no regular file; give the file itself")
        with zipfile.ZipFile(file) as archive:
            unpacked_bytes = sum(m.file_size for m in archive.infolist() if m.filename.removesuffix(".npy") in wanted)
        if unpacked_bytes > max_bytes:
            limit = max_bytes // 1_000_000
            raise InputError(f"{path}: unpacks to {unpacked_bytes / 1e6:.0f} MB; at most {limit} MB are read")
        file.seek(0)
        with np.load(file, allow_pickle=False) as stored:
            found = {name: stored[name] for name in stored.files if name in wanted}
    if not all(isinstance(array, np.ndarray) for array in found.values()):  # a member that is no .npy file: bytes
        raise ValueError("not arrays")
    return found


def check_image_size(path: Path, width_px: float, height_px: float) -> tuple[int, int]:
    """Return the declared (width, height) if sane, before anything is allocated for it. Raises InputError otherwise."""
    short_px, long_px = sorted((width_px, height_px))
    if not (short_px >= 1 and long_px <= MAX_SIDE_PX and short_px * long_px <= MAX_IMAGE_PIXELS):
        raise InputError(
            f"{path}: declares {width_px:g} x {height_px:g} px; give 1 to {MAX_IMAGE_PIXELS // 1_000_000} million "
            f"pixels, no side over {MAX_SIDE_PX}"
        )
    return int(width_px), int(height_px)


def read_image(path: Path) -> np.ndarray:
    """Read an image, turned upright by its EXIF orientation, as (H, W, 3) uint8 RGB. Raises InputError if it is not a
    whole 8-bit JPEG or PNG of a sane size."""
    return _read_image(path, _colours)


def read_mask(path: Path) -> np.ndarray:
    """Read a mask, (H, W) uint8: the opacity of a cut-out person, else the maximum of the colour channels. Raises
    InputError as `read_image` does."""
    mask = _read_image(path, lambda image: _opacity(image) or _colours(image))
    return mask if mask.ndim == 2 else mask.max(-1)


def _colours(image: Image.Image) -> Image.Image:
    return image if image.mode == "RGB" else image.convert("RGB")


def _opacity(image: Image.Image) -> Image.Image | None:
    """Return the opacity of an image; None if it is opaque everywhere."""
    if image.mode not in ("LA", "RGBA") and "transparency" not in image.info:
        return None
    opacity = image.convert("RGBA").getchannel("A")
    return opacity if np.asarray(opacity).min() < 255 else None


def _read_image(path: Path, wanted: Callable[[Image.Image], Image.Image]) -> np.ndarray:
    """Read an image, converted by `wanted` and turned upright by its EXIF orientation. Raises InputError as
    `read_image` does."""
    image: Image.Image  # one at a time: each conversion is another copy
    try:
        with Image.open(path, formats=["JPEG", "PNG"]) as image:
            if (size_bytes := path.stat().st_size) > MAX_IMAGE_BYTES:
                raise InputError(f"{path}: {size_bytes} bytes are too many for an image; export it again")
            check_image_size(path, *image.size)
            if image.mode not in _IMAGE_MODES:
                raise InputError(f"{path}: pixels are {image.mode}; export it again as RGB or grey, 8 bits a channel")
            image.load()
        turn = _UPRIGHT.get(_orientation(image))
        image = wanted(image)
        image = image if turn is None else image.transpose(turn)
        return np.array(image)
    except FileNotFoundError:
        raise InputError(f"{path}: image missing; add it to the capture folder") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise_if_unreachable(error)
        reason = getattr(error, "strerror", None) or one_line(error)
        raise InputError(f"{path}: not a readable image ({reason}); export it again as JPEG or PNG") from None


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation of an image; 0 where none can be read."""
    exif = Image.Exif()
    try:
        exif.load(image.info.get("exif", b""))
        return int(exif.get(_EXIF_ORIENTATION, 0))
    except Exception:  # damaged EXIF can raise nearly anything
        return 0
