"""The images of one camera as recorded: a folder of image files, or a video."""

import os
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, NamedTuple

import cv2
import numpy as np

from hnerf.capture.boxes import check_tables
from hnerf.capture.safe_io import check_image_size, read_image
from hnerf.capture.video_metadata import opencv_inverts
from hnerf.errors import InputError
from hnerf.progress import report

# Our own message, one line, replaces what OpenCV and FFmpeg would print about a bad video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


# Only MP4 and QuickTime, whatever the file's name: other formats, such as playlists, make FFmpeg read further files.
FORMATS = "format_whitelist;mov"
PROGRESS_FRAMES = 100  # between two reports
MIN_FPS, MAX_FPS = 0.01, 10_000.0  # of a recording
MAX_PIXEL_ASPECT = 3.0  # anamorphic lenses, as the widest pixels that are filmed, squeeze pictures by 2


class VideoFrame(NamedTuple):
    """One frame: RGB (H, W, 3) uint8, and the image file that holds exactly these pixels, if there is one."""

    frame: int
    rgb: np.ndarray
    file: Path | None

    @property
    def size_px(self) -> tuple[int, int]:
        """Return the image's (width, height)."""
        return self.rgb.shape[1], self.rgb.shape[0]


@dataclass(frozen=True)
class ImageFolder:
    """Image files of one camera by frame number."""

    path: Path
    files: dict[int, Path]
    fps: ClassVar[None] = None  # images state none

    @property
    def frames(self) -> tuple[int, ...]:
        """Return the frame numbers, ascending."""
        return tuple(sorted(self.files))

    def read(self, wanted: Iterable[int]) -> Iterator[VideoFrame]:
        """Yield the wanted frames in ascending order. Raises InputError if one cannot be read."""
        for frame in sorted(wanted):
            yield VideoFrame(frame, read_image(self.files[frame]), self.files[frame])


@dataclass(frozen=True)
class Video:
    """A video file of which every frame can be decoded. frames: numbered from 0, without those that its edit list
    hides; times_s: when each is shown, if the file states it."""

    path: Path
    frames: tuple[int, ...]
    fps: float | None
    times_s: tuple[float, ...] = ()

    @staticmethod
    def open(path: Path) -> "Video":
        """Open a video and count its frames by decoding: the header proves nothing (a codec may be missing, the file
        may be truncated)."""
        stream = _open_stream(path)
        check_image_size(path, stream.get(cv2.CAP_PROP_FRAME_WIDTH), stream.get(cv2.CAP_PROP_FRAME_HEIGHT))
        declared, times_s = int(stream.get(cv2.CAP_PROP_FRAME_COUNT)), _times_s(path, stream)
        count = len(times_s)
        readable = len(_times_s(path, _open_stream(path, "ignore_editlist;1"))) if count < declared else count
        if count == 0 or readable != declared:
            raise InputError(
                f"{path}: {declared} frames declared, {readable} could be read; export it again whole, as H.264"
            )
        ascending = all(a < b for a, b in pairwise(times_s))
        declared_fps = stream.get(cv2.CAP_PROP_FPS)
        fps = declared_fps if MIN_FPS <= declared_fps <= MAX_FPS else None
        return Video(path, tuple(range(count)), fps, tuple(times_s) if ascending else ())

    def read(self, wanted: Iterable[int]) -> Iterator[VideoFrame]:
        """Yield the wanted frames in ascending order, turned as the file states, but not mirrored. Raises InputError if
        one cannot be read, or if they all look the same: OpenCV cannot convert interlaced pictures, returns what its
        memory holds, and reports success."""
        stream, position, inverted = _open_stream(self.path), 0, opencv_inverts(self.path)
        frames, digests = sorted(wanted), set[int]()
        for frame in frames:
            while position < frame and stream.grab():
                position += 1
            ok, bgr = stream.read()
            if not ok:
                raise InputError(f"{self.path}: frame {frame} cannot be read; export the video again as H.264")
            position += 1
            digests.add(zlib.crc32(bgr.tobytes()))
            rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
            yield VideoFrame(frame, cv2.rotate(rgb, cv2.ROTATE_180) if inverted else rgb, None)
        if len(digests) == 1 < len(frames):
            raise InputError(
                f"{self.path}: its pictures look the same; if it is interlaced, export it as progressive H.264"
            )

    @property
    def pixel_aspect(self) -> float:
        """Return the width of a pixel over its height, as the file states it, turned as pictures are; 1 if it states
        none that a camera could have."""
        stream = _open_stream(self.path)
        width, height = stream.get(cv2.CAP_PROP_SAR_NUM), stream.get(cv2.CAP_PROP_SAR_DEN)
        if not 1 / MAX_PIXEL_ASPECT <= width / max(height, 1) <= MAX_PIXEL_ASPECT:
            return 1.0
        return height / width if stream.get(cv2.CAP_PROP_ORIENTATION_META) % 180 else width / height


Footage = ImageFolder | Video


def _times_s(path: Path, stream: cv2.VideoCapture) -> list[float]:
    """Decode a video; return when each frame is shown, up to one frame more than the file declares."""
    declared, times_s = int(stream.get(cv2.CAP_PROP_FRAME_COUNT)), list[float]()
    while len(times_s) <= declared and stream.grab():
        times_s.append(stream.get(cv2.CAP_PROP_POS_MSEC) / 1e3)
        if len(times_s) % PROGRESS_FRAMES == 0:
            report(path.name, len(times_s), declared + 1)
    report(path.name, 1, 1)
    return times_s


def _open_stream(path: Path, *options: str) -> cv2.VideoCapture:
    """Open a video. options: FFmpeg's, as `name;value`."""
    if not path.is_file():
        raise InputError(f"{path}: video missing; every calibrated camera needs one")
    check_tables(path)
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = "|".join([FORMATS, *options])
    # FFmpeg takes what precedes a colon in a relative path for a protocol.
    stream = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    if not stream.isOpened():
        raise InputError(f"{path}: not a readable video; export it again as H.264")
    return stream
