"""Footage of a calibration board: the board's description, and its corners in the images.

`calibration/extrinsic/` and `calibration/intrinsic/` hold a video `<camera>.mp4` or a folder of images `<camera>/` per
camera; `charuco.toml` (Caliscope's keys) or a table `[board]` in `capture.toml` describes the board.
"""

import csv
import dataclasses
import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hnerf.capture import safe_io
from hnerf.capture.footage import Footage, ImageFolder, Video
from hnerf.capture.manifest import MAX_BYTES
from hnerf.capture.normalise import Normaliser
from hnerf.config import validated
from hnerf.errors import InputError

MAX_FRAMES = 200  # evenly strided frames of each camera in which the board is searched for
MAX_TABLE_BYTES = 2_000_000  # of timestamps.csv: a hundred thousand rows
MIN_CHECKERBOARD = 4  # squares on a side: OpenCV takes three corners for a row
BOARDS_FILE = "boards.npz"
METRES = {"inch": 0.0254, "cm": 0.01}

log = logging.getLogger("hnerf.capture")


class Board(BaseModel):
    """A flat board of squares: ChArUco, or a plain checkerboard without a marker dictionary.

    `marker_share`: side of a marker relative to a square's; `inverted`: printed white on black;
    `legacy_pattern`: ChArUco as OpenCV drew it before version 4.6, which differs if `rows` is even.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    columns: int = Field(ge=3, le=64)
    rows: int = Field(ge=3, le=64)
    square_m: float = Field(ge=1e-4, le=2)
    dictionary: str | None = Field(default=None, pattern=r"^DICT_[A-Za-z0-9_]{1,32}$")
    marker_share: float = Field(default=0.75, ge=0.1, le=0.99)
    inverted: bool = False
    legacy_pattern: bool = False

    @property
    def corners_m(self) -> np.ndarray:
        """Return the inner corners row by row, (N, 3): x right, y down, z into the board, from its top left corner."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns]
        return self.square_m * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)


class BoardDetector:
    """Detector of one board in images."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self.charuco = None
        if board.dictionary:
            parameters = cv2.aruco.CharucoParameters()
            parameters.minMarkers = 1  # a hand may hide one of a corner's two markers; bad corners are dropped later
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
            size, marker_m = (board.columns, board.rows), board.marker_share * board.square_m
            squares = cv2.aruco.CharucoBoard(size, board.square_m, marker_m, dictionary)
            squares.setLegacyPattern(board.legacy_pattern)
            self.charuco = cv2.aruco.CharucoDetector(squares, parameters)

    def corners_px(self, rgb: np.ndarray) -> np.ndarray:
        """Return the board's corners in an RGB image, (N, 2), NaN where not seen."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self.board.inverted:
            grey = 255 - grey
        if self.charuco is None:
            return self._checkerboard(grey)
        corners_px = np.full((len(self.board.corners_m), 2), np.nan)
        found, ids, _, _ = self.charuco.detectBoard(grey)
        if ids is not None:
            corners_px[ids.ravel()] = found.reshape(-1, 2)
        return corners_px

    def _checkerboard(self, grey: np.ndarray) -> np.ndarray:
        """Return all corners, or only NaN; they start at the same physical corner however the board is held.

        `read_board` accepts only boards whose first and last square differ in colour; the black one is first.
        """
        columns, rows = self.board.columns - 1, self.board.rows - 1
        found, corners_px = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            return np.full((columns * rows, 2), np.nan)
        grid = corners_px.reshape(rows, columns, 2).astype(np.float64)
        if _brightness(grey, grid[:2, :2]) > _brightness(grey, grid[-2:, -2:]):
            grid = grid[::-1, ::-1]
        return grid.reshape(-1, 2)


@dataclass(frozen=True)
class BoardFootage:
    """Corners in the footage of a board. corners_px: per camera (frames, N, 2) as recorded, NaN where not seen, in the
    order of `frames`, which are every `frame_step`-th of the footage; if it is intrinsic, in every n-th of the camera's
    own frames."""

    path: Path
    board: Board
    frames: tuple[int, ...]
    frame_step: int
    corners_px: dict[str, np.ndarray]
    sizes_px: dict[str, tuple[int, int]]


@dataclass(frozen=True)
class BoardCorners:
    """Corners of a board, which a normalised capture keeps as `boards.npz`: corners_m (N, 3) on the board; corners_px
    (C, F, N, 2) in the linear cameras' pixels, NaN where not seen, in every `frame_step`-th frame of the footage;
    frames (F,): their numbers."""

    cameras: tuple[str, ...]
    corners_m: np.ndarray
    corners_px: np.ndarray
    frame_step: int
    frames: tuple[int, ...]

    def select(self, cameras: Sequence[str]) -> "BoardCorners":
        """Return the corners that these cameras saw."""
        rows = [self.cameras.index(name) for name in cameras]
        return dataclasses.replace(self, cameras=tuple(cameras), corners_px=self.corners_px[rows])

    def save(self, root: Path) -> None:
        """Write `boards.npz` into a normalised capture."""
        np.savez_compressed(root / BOARDS_FILE, **dataclasses.asdict(self))


def normalised_corners(footage: BoardFootage, normalisers: dict[str, Normaliser]) -> BoardCorners:
    """Return the corners that a capture's cameras saw, in the pixels of the linear cameras. Raises InputError if a
    camera recorded the board at another size."""
    names = tuple(name for name in footage.corners_px if name in normalisers)
    if not names:
        raise InputError(
            f"{footage.path}: shows cameras {', '.join(footage.corners_px)}, none of them recorded here; rename them"
        )
    corners_px = []
    for name in names:
        size_px, recorded_px = footage.sizes_px[name], normalisers[name].recorded_size_px
        if size_px != recorded_px:
            raise InputError(
                f"{footage.path / name}: is {size_px[0]} x {size_px[1]} px, but the recording of that camera is "
                f"{recorded_px[0]} x {recorded_px[1]}; film the board at the same size or take its footage out"
            )
        seen = np.isfinite(footage.corners_px[name][..., :1])
        corners = np.concatenate([np.nan_to_num(footage.corners_px[name]), seen], -1)
        straight = normalisers[name].keypoints(corners)
        corners_px.append(np.where(straight[..., 2:] > 0, straight[..., :2], np.nan))
    return BoardCorners(names, footage.board.corners_m, np.array(corners_px), footage.frame_step, footage.frames)


def load_board_corners(root: Path) -> BoardCorners | None:
    """Load the board corners of a normalised capture; None if the recording has no footage of a board."""
    if not (root / BOARDS_FILE).exists():
        return None
    with np.load(root / BOARDS_FILE, allow_pickle=False) as stored:
        cameras, frames = (tuple(stored[name].tolist()) for name in ("cameras", "frames"))
        return BoardCorners(cameras, stored["corners_m"], stored["corners_px"], int(stored["frame_step"]), frames)


def read_board(folder: Path) -> Board | None:
    """Read the description of the board in a folder; None if there is none. Raises InputError on a bad one."""
    manifest, charuco = safe_io.path_in_capture(folder, "capture.toml"), safe_io.path_in_capture(folder, "charuco.toml")
    source, table = manifest, (safe_io.read_toml(manifest, MAX_BYTES) if manifest.exists() else {}).get("board")
    if table is None:
        if not charuco.exists():
            return None
        source, table = charuco, _from_caliscope(charuco)
    board = validated(Board, table, f"{source}: board")
    if board.dictionary is None and min(board.columns, board.rows) < MIN_CHECKERBOARD:
        raise InputError(
            f"{source}: OpenCV finds no checkerboard of {board.columns} x {board.rows} squares; use one with at least "
            f"{MIN_CHECKERBOARD} on each side, or a ChArUco board"
        )
    if board.dictionary is None and (board.columns + board.rows) % 2 == 0:
        raise InputError(
            f"{source}: a checkerboard of {board.columns} x {board.rows} squares looks the same upside down; "
            "use one with an odd and an even number of squares, or a ChArUco board"
        )
    if board.dictionary:
        _check_markers(source, board)
    return board


def read_board_footage(
    folder: Path, part: Literal["extrinsic", "intrinsic"], wanted: int | None = None
) -> BoardFootage | None:
    """Return the corners in the footage of calibration/<part>/; None if there is no footage or no board is
    described.

    In long footage only every n-th frame is examined, including frame `wanted` if it is given. In extrinsic footage,
    images with the same frame number are assumed to be simultaneous in all cameras; videos are numbered by Caliscope's
    `timestamps.csv` if there is one. Intrinsic footage shows one camera at a time, so that n differs between cameras.
    Raises InputError on files that cannot be read or do not match, or if there is no frame `wanted`.
    """
    path = safe_io.path_in_capture(folder, "calibration", part)
    footage, board = _footage(folder, part), read_board(folder)
    if footage and board is None:
        log.info("%s: not used, as neither charuco.toml nor [board] in capture.toml describes the board", path)
    if not footage or board is None:
        return None
    numbers = _frame_numbers(path, footage, synchronised=part == "extrinsic")
    frames = tuple(sorted({number for of_camera in numbers.values() for number in of_camera}))
    if wanted is not None and wanted not in frames:
        raise InputError(f"{path}: has no frame {wanted}; name one of {frames[0]} to {frames[-1]}")
    step = math.ceil(len(frames) / MAX_FRAMES)
    frames = frames[0 if wanted is None else frames.index(wanted) % step :: step]
    corners_px, sizes_px = {}, {}
    for name, pictures in footage.items():
        own = frames if part == "extrinsic" else numbers[name][:: math.ceil(len(numbers[name]) / MAX_FRAMES)]
        corners_px[name], sizes_px[name] = _corners(board, pictures, numbers[name], own)
        shown = int(np.isfinite(corners_px[name][..., 0]).any(-1).sum())
        log.info("%s: board found in %d of %d frames", pictures.path, shown, len(own))
    return BoardFootage(path, board, frames, step, corners_px, sizes_px)


def _corners(
    board: Board, pictures: Footage, numbers: tuple[int, ...], frames: tuple[int, ...]
) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the corners of one camera, (frames, N, 2), and the size of its images. numbers: as from `_frame_numbers`,
    for each of the camera's own frames."""
    detector, size_px = BoardDetector(board), None
    corners_px = np.full((len(frames), len(board.corners_m), 2), np.nan)
    row = {frame: i for i, frame in enumerate(frames)}
    wanted = {own: row[number] for number, own in zip(numbers, pictures.frames, strict=True) if number in row}
    for picture in pictures.read(wanted):
        size_px = size_px or picture.size_px
        if picture.size_px != size_px:
            width_px, height_px = picture.size_px
            raise InputError(
                f"{picture.file}: is {width_px} x {height_px} px, unlike the pictures before; use one size"
            )
        corners_px[wanted[picture.frame]] = detector.corners_px(picture.rgb)
    if size_px is None:
        raise InputError(f"{pictures.path}: none of its frames is examined; give all cameras the same frames")
    return corners_px, size_px


def _check_markers(source: Path, board: Board) -> None:
    """Raise InputError unless OpenCV has the dictionary, with enough markers for the board."""
    known = getattr(cv2.aruco, board.dictionary or "", None)
    if not isinstance(known, int):
        raise InputError(f"{source}: board: dictionary {board.dictionary}: not one of OpenCV's; correct it")
    have = len(cv2.aruco.getPredefinedDictionary(known).bytesList)
    if have < board.columns * board.rows // 2:
        raise InputError(f"{source}: board: {board.dictionary} has only {have} markers; correct rows and columns")


def _from_caliscope(path: Path) -> dict[str, Any]:
    """Convert Caliscope's charuco.toml to keys of `Board`; a square size measured on the print overrides the one that
    follows from the page."""
    table = safe_io.read_toml(path)
    try:
        square_m = 0.01 * float(table.get("square_size_override_cm") or 0)
        if not square_m:
            sides = table["board_width"] / table["columns"], table["board_height"] / table["rows"]
            square_m = METRES[table["units"]] * float(min(sides))
        return {
            "columns": table["columns"],
            "rows": table["rows"],
            "square_m": square_m,
            "dictionary": table["dictionary"],
            "marker_share": table["aruco_scale"],
            "inverted": table["inverted"],
            "legacy_pattern": table.get("legacy_pattern", False),
        }
    except (KeyError, OverflowError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path}: board: {error} is missing or not a number; write it again with Caliscope") from None


def _footage(folder: Path, part: str) -> dict[str, Footage]:
    """Return the footage by camera, in the order of the cameras' names."""
    root = safe_io.path_in_capture(folder, "calibration", part)
    found: dict[str, Footage] = {}
    for path in sorted(root.iterdir()) if root.is_dir() else []:
        if path.name.startswith(".") or (path.is_file() and path.suffix.lower() not in safe_io.VIDEO_SUFFIXES):
            continue
        path = safe_io.path_in_capture(folder, "calibration", part, path.name)
        name = safe_io.check_camera_name(path.stem if path.is_file() else path.name, path)
        if name in found:
            raise InputError(f"{path}: camera {name} has a video and a folder of images; keep one of them")
        if path.is_file():
            found[name] = Video.open(path)
        elif files := safe_io.files_in(folder, "calibration", part, path.name, suffixes=safe_io.IMAGE_SUFFIXES):
            found[name] = ImageFolder(path, safe_io.numbered(files, "images"))
        else:  # such as the CHARUCO/ that Caliscope leaves here
            log.warning("%s: holds no JPEG or PNG images; ignored", path)
    return found


def _frame_numbers(root: Path, footage: dict[str, Footage], synchronised: bool) -> dict[str, tuple[int, ...]]:
    """Return, by camera, the number of each of its frames, which simultaneous frames of all cameras share."""
    stamps = safe_io.path_in_capture(root, "timestamps.csv")
    if not synchronised or not stamps.exists():
        videos = [pictures for pictures in footage.values() if isinstance(pictures, Video)]
        if synchronised and len({len(video.frames) for video in videos}) > 1:
            raise InputError(f"{root}: the videos differ in length; cut them to the same frames")
        return {name: pictures.frames for name, pictures in footage.items()}
    numbers = _sync_indices(stamps)
    for name, pictures in footage.items():
        if len(numbers.get(name, ())) != len(pictures.frames):
            raise InputError(
                f"{stamps}: {len(numbers.get(name, ()))} rows of {name}, but {len(pictures.frames)} frames in "
                f"{pictures.path}; export both again, or remove the table if all cameras have the same frames"
            )
    return numbers


def _sync_indices(path: Path) -> dict[str, tuple[int, ...]]:
    """Read Caliscope's table: a row for every frame of every camera, with a `sync_index` that simultaneous frames
    share. Raises InputError if it is no such table."""
    found: dict[str, list[int]] = {}
    try:
        rows = list(csv.DictReader(safe_io.read_text(path, MAX_TABLE_BYTES).splitlines()))
    except csv.Error as error:  # such as a field longer than 128 KiB
        raise InputError(f"{path}: not a table ({error}); export it again or remove it") from None
    for row in rows:
        index, camera = row.get("sync_index") or "", row.get("cam_id") or row.get("port") or ""
        if not (re.fullmatch(r"[0-9]{1,9}", index) and re.fullmatch(r"[0-9]{1,4}", camera)):
            raise InputError(f"{path}: a row lacks a whole-numbered sync_index or cam_id; export it again or remove it")
        found.setdefault(f"cam_{camera}", []).append(int(index))
    return {name: tuple(sorted(indices)) for name, indices in found.items()}


def _brightness(grey: np.ndarray, square_px: np.ndarray) -> float:
    """Return the mean grey level in the middle half of the square between (2, 2, 2) corners."""
    middle = square_px.mean((0, 1))
    inner = (middle + 0.5 * (square_px - middle)).reshape(4, 2)[[0, 1, 3, 2]]
    mask = np.zeros_like(grey)
    cv2.fillConvexPoly(mask, inner.round().astype(np.int32), 255)
    return float(cv2.mean(grey, mask)[0])
