"""The normalised capture that every later stage reads.

A normalised capture is a folder with `capture.json`, `images/<camera>/<frame:06d>.<ext>` (undistorted) and, if the
recording has them, `background/<camera>.<ext>` (clean plates), `masks/<camera>/<frame:06d>.png`, `keypoints.npz`,
`given_hands.npz`, `poses.npz` and `boards.npz` (corners of boards); if a network detected people,
`landmarks/<camera>.npz` and `person/<camera>/<frame:06d>.png`; once hands were looked for, `hands.npz`.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from hnerf.capture.bars import Area
from hnerf.capture.footage import MAX_FPS, MIN_FPS
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.lens import Lens, checked_lens
from hnerf.capture.safe_io import IMAGE_SUFFIXES, check_image_size
from hnerf.capture.timing import median_step, nearest_frame, resample
from hnerf.errors import InputError, raise_if_unreachable
from hnerf.geometry.camera import Camera

PERSON = "person"  # folder: <camera>/<frame>.png, 255 times the probability
KEYPOINTS = "keypoints.npz"  # by camera
LANDMARKS = "landmarks"  # folder: <camera>.npz, of people
GIVEN_HANDS = "given_hands.npz"  # by camera: points of the hands of all people, as recorded
HANDS = "hands.npz"  # by camera: points of the subject's hands, as recorded or found by a network
JPEG_OPTIONS = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


class SubjectPoint(NamedTuple):
    """The point by which `capture.toml` names the subject. at (2,): metres on the ground, in the world's two horizontal
    axes; or pixels of the image of `frame`, if a `camera` is named."""

    at: tuple[float, float]
    camera: str = ""
    frame: int = 0


StoredLens = tuple[list[list[float]], list[float], *tuple[bool, ...]]  # K, distortion and, of a fisheye, True


def stored_lens(lens: Lens) -> StoredLens:
    """Return what `capture.json` holds of a lens."""
    return lens.K.tolist(), lens.distortion.tolist(), *[True] * lens.fisheye


@dataclass(frozen=True)
class Capture:
    """A normalised capture: cameras, frames, splits and where the images lie. Test cameras are for scoring only.

    `calibrated_sizes_px`: per camera the (width, height) at which the calibration was made; `recorded_sizes_px`: the
    (width, height) of the recorded files; `picture_areas_px`: the part of the recorded image that the calibrated
    picture fills, if black bars prove it; ingestion changed K accordingly. `up`: "z" or "y", the world's vertical axis.
    `frame_offsets`: of cameras that are not synchronised (hnerf.capture.timing); `stored_frames`: the frames in the
    files, if some were dropped since; `frame_step`: the distance of frame numbers in the recording. `recorded_lenses`:
    `stored_lens` of the recorded files, for cameras that were undistorted. `subject_point`: None if nobody is named.
    `stature_m`: the person's, if `capture.toml` states it. `notes`: how cameras and clocks were found, for the report.
    """

    name: str
    root: Path
    cameras: dict[str, Camera]
    train_cameras: tuple[str, ...]
    test_cameras: tuple[str, ...]
    train_frames: tuple[int, ...]
    novel_pose_frames: tuple[int, ...]
    fps: float
    up: str
    calibrated_sizes_px: dict[str, tuple[int, int]]
    recorded_sizes_px: dict[str, tuple[int, int]]
    picture_areas_px: dict[str, Area] = dataclasses.field(default_factory=dict)
    frame_offsets: dict[str, float] = dataclasses.field(default_factory=dict)
    stored_frames: tuple[int, ...] = ()
    frame_step: int = 1
    recorded_lenses: dict[str, StoredLens] = dataclasses.field(default_factory=dict)
    subject_point: SubjectPoint | None = None
    stature_m: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> tuple[int, ...]:
        """Return every frame for which a pose is needed, ascending."""
        return tuple(sorted(set(self.train_frames) | set(self.novel_pose_frames)))

    def recorded_lens(self, camera: str) -> Lens | None:
        """Return the lens of a camera's recorded files; None if they were not undistorted."""
        if camera not in self.recorded_lenses:
            return None
        K, distortion, *fisheye = self.recorded_lenses[camera]
        posed, size_px = self.cameras[camera], self.recorded_sizes_px[camera]
        return Lens(camera, np.array(K), np.array(distortion), posed.R, posed.t_m, size_px, fisheye=any(fisheye))

    def image(self, camera: str, frame: int) -> np.ndarray:
        """Read the image recorded nearest in time to a frame, (H, W, 3) uint8 RGB. Raises InputError without one."""
        stem = self.root / "images" / camera / f"{self.recorded_frame(camera, frame):06d}"
        paths = (stem.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)  # a search of the folder slows down as it grows
        found = next((path for path in paths if path.exists()), None)
        if found is None:
            raise InputError(f"{stem}.*: image missing; every camera needs every frame")
        return read_rgb(found)

    def background(self, camera: str) -> np.ndarray | None:
        """Read the clean plate, (H, W, 3) uint8 RGB; None if the recording has none."""
        found = list((self.root / "background").glob(f"{camera}.*"))
        return read_rgb(found[0]) if found else None

    def has_given_mask(self, camera: str, frame: int) -> bool:
        """Return whether there is a given mask of a frame."""
        return self._grey_path("masks", camera, frame).exists()

    def given_mask(self, camera: str, frame: int) -> np.ndarray | None:
        """Read the given mask recorded nearest in time to a frame, (H, W) bool, True on the person; None if there is
        none."""
        mask = self._grey("masks", camera, frame, "write it again or delete it")
        return None if mask is None else mask > 127

    def person_probability(self, camera: str, frame: int) -> np.ndarray | None:
        """Return a network's probability that a pixel shows a person, (H, W) float32, in the recorded frame nearest in
        time; None if no network was run."""
        likely = self._grey(PERSON, camera, frame, "detect again")
        return None if likely is None else likely.astype(np.float32) / 255

    def _grey(self, folder: str, camera: str, frame: int, advice: str) -> np.ndarray | None:
        path = self._grey_path(folder, camera, frame)
        grey = _decoded(path, cv2.IMREAD_GRAYSCALE)
        if grey is None and path.exists():
            raise InputError(f"{path}: not a readable image; {advice}")
        return grey

    def _grey_path(self, folder: str, camera: str, frame: int) -> Path:
        return self.root / folder / camera / f"{self.recorded_frame(camera, frame):06d}.png"

    def keypoints(self, camera: str) -> np.ndarray | None:
        """Return BODY_25 keypoints (frames, people, 25, 3) x_px, y_px, confidence in the order of `frames`; all 0 where
        absent.

        They are interpolated between recorded frames if the camera is not synchronised.
        """
        return self._points(KEYPOINTS, camera)

    def hands(self, camera: str) -> np.ndarray | None:
        """Return the subject's left and right hand (frames, 2, 21, 3) in the order of `keypoints`; None if hands were
        not looked for."""
        return self._points(HANDS, camera)

    def given_hands(self, camera: str) -> np.ndarray | None:
        """Return the left and right hands (frames, people, 2, 21, 3) of the people in `keypoints`, as the recording's
        own files have them; None if they have none. Only of a capture whose cameras are not synchronised yet."""
        return self._stored(GIVEN_HANDS, camera)

    def landmarks(self, camera: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Return a network's landmarks of people (frames, people, 33, 3) in the order of `frames`, each from the
        recorded frame nearest in time: x_px, y_px and confidence; and metres from the midpoint of the hips along the
        camera's axes. None if no network was run."""
        path = self.root / LANDMARKS / f"{camera}.npz"
        if not path.exists():
            return None
        stored = self.stored_frames or self.frames
        recorded = [self.recorded_frame(camera, frame) for frame in self.frames]
        rows = np.searchsorted(stored, recorded).clip(max=len(stored) - 1)
        with np.load(path, allow_pickle=False) as found:
            return found["points_px"][rows], found["points_m"][rows]

    def _stored(self, file: str, camera: str) -> np.ndarray | None:
        if not (self.root / file).exists():
            return None
        with np.load(self.root / file, allow_pickle=False) as stored:
            return stored.get(camera)

    def _points(self, file: str, camera: str) -> np.ndarray | None:
        found = self._stored(file, camera)
        if found is None or not self.stored_frames:
            return found
        instants = np.array(self.frames) + self.frame_offsets.get(camera, 0.0)
        return resample(found, self.stored_frames, instants, in_order=file == HANDS)

    @property
    def has_keypoints(self) -> bool:
        """Return whether any keypoints were detected in this recording."""
        return (self.root / KEYPOINTS).exists()

    @property
    def has_given_hands(self) -> bool:
        """Return whether the recording's own files have points of anybody's hands."""
        return (self.root / GIVEN_HANDS).exists()

    @property
    def has_person_masks(self) -> bool:
        """Return whether all training cameras have person masks from a network."""
        return all((self.root / PERSON / camera).is_dir() for camera in self.train_cameras)

    def given_poses(self) -> GivenPoses | None:
        """Return the poses of a body model that come with the recording, a row for each of `frames`; None if no frame
        has one."""
        path = self.root / "poses.npz"
        if not path.exists():
            return None
        poses = GivenPoses.load(path)
        rows = np.searchsorted(self.stored_frames or self.frames, self.frames)
        poses = dataclasses.replace(poses, theta=poses.theta[rows], root=poses.root[rows])
        return poses if poses.known.any() else None

    def with_cameras(self, cameras: dict[str, Camera]) -> "Capture":
        """Return the same recording seen through other (refined) cameras."""
        return dataclasses.replace(self, cameras=cameras)

    def synchronised(self, frame_offsets: dict[str, float]) -> "Capture":
        """Return the same recording with these frame offsets, without the frames that any camera did not record.

        If that would drop most frames because frames in between were not ingested, the nearest ingested ones are used
        instead.
        """
        stored = self.stored_frames or self.frames
        present = frozenset(stored)
        for step in (self.frame_step, median_step(stored)):
            kept = {f for f in stored if all(nearest_frame(f, o, step) in present for o in frame_offsets.values())}
            if 2 * len(kept) >= len(stored):
                break
        return dataclasses.replace(
            self,
            frame_step=step,
            train_frames=tuple(f for f in self.train_frames if f in kept),
            novel_pose_frames=tuple(f for f in self.novel_pose_frames if f in kept),
            frame_offsets=frame_offsets,
            stored_frames=stored,
        )

    def recorded_frame(self, camera: str, frame: int) -> int:
        """Return the number of the camera's recorded frame that is nearest in time to a frame."""
        return nearest_frame(frame, self.frame_offsets.get(camera, 0.0), self.frame_step)

    def save(self) -> None:
        """Write `capture.json` into `root`."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in ("root", "cameras")}
        plain["cameras"] = {
            c.name: {"K": c.K.tolist(), "R": c.R.tolist(), "t_m": c.t_m.tolist(), "size_px": c.size_px}
            for c in self.cameras.values()
        }
        plain["units"] = "m"
        (self.root / "capture.json").write_text(json.dumps(plain, indent=1))

    @staticmethod
    def load(root: Path) -> "Capture":
        """Read a normalised capture folder. Raises ValueError, InputError or others if `save` did not write it."""
        plain: dict[str, Any] = json.loads((root / "capture.json").read_text())
        del plain["units"]
        cameras = {name: _camera(root / "capture.json", name, c) for name, c in plain.pop("cameras").items()}
        tuples = ("train_cameras", "test_cameras", "train_frames", "novel_pose_frames")
        sizes = ("calibrated_sizes_px", "recorded_sizes_px")
        plain |= {k: tuple(plain[k]) for k in tuples}
        plain |= {k: tuple(plain.get(k, ())) for k in ("stored_frames", "notes")}
        plain |= {k: {name: tuple(size) for name, size in plain[k].items()} for k in sizes}
        plain["picture_areas_px"] = {name: Area(*area) for name, area in plain.get("picture_areas_px", {}).items()}
        if point := plain.get("subject_point"):
            plain["subject_point"] = SubjectPoint(tuple(point[0]), *point[1:])
        return checked_capture(Capture(root=root, cameras=cameras, **plain))


def _camera(source: Path, name: str, described: dict[str, Any]) -> Camera:
    """Return the camera that a file describes. Raises ValueError, InputError or others if the description is
    invalid."""
    K, R, t_m = (np.array(described[key]) for key in ("K", "R", "t_m"))
    lens = checked_lens(source, name, K, np.zeros(4), R, t_m, None)
    return Camera(name, lens.K, lens.R, lens.t_m, *check_image_size(source, *described["size_px"]))


def checked_capture(capture: Capture) -> Capture:
    """Return the capture unchanged. Raises ValueError unless it has training cameras, all its cameras are known, and
    its frame rate and vertical axis are valid."""
    if not capture.train_cameras or not {*capture.train_cameras, *capture.test_cameras} <= capture.cameras.keys():
        raise ValueError("no training camera, or an unknown camera")
    if not MIN_FPS <= capture.fps <= MAX_FPS:
        raise ValueError(f"fps: {capture.fps}")
    if capture.up not in ("y", "z"):
        raise ValueError(f"up: {capture.up}")
    return capture


def read_rgb(path: Path) -> np.ndarray:
    """Read an image file as (H, W, 3) uint8 RGB. Raises InputError if it cannot be read."""
    bgr = _decoded(path, cv2.IMREAD_COLOR)
    if bgr is None:
        raise InputError(f"{path}: not a readable image; export it again as JPEG or PNG")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def read_rgba(path: Path) -> np.ndarray:
    """Read an image file that `write_image` wrote as (H, W, 4) uint8. Raises InputError if it cannot be read or has no
    alpha."""
    bgra = _decoded(path, cv2.IMREAD_UNCHANGED)
    if bgra is None or bgra.shape[2:] != (4,):
        raise InputError(f"{path}: no readable image with an alpha channel; make it again")
    return cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGBA)


def _decoded(path: Path, mode: int) -> np.ndarray | None:
    """Return the image in a file as OpenCV has it, channels last and blue first; None if there is none."""
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise_if_unreachable(error)
        return None
    return cv2.imdecode(content, mode) if len(content) else None


def to_8_bit(levels: np.ndarray) -> np.ndarray:
    """Round levels of 255 to uint8; levels beyond are clipped."""
    return levels.round().clip(0, 255).astype(np.uint8)


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write an image, grey (H, W), RGB (H, W, 3) or RGBA (H, W, 4), in the format of the file's suffix; create its
    folder if needed. JPEG is written without chroma subsampling. Raises OSError if the file cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    colour = pixels.ndim == 3
    as_stored = np.concatenate([pixels[..., 2::-1], pixels[..., 3:]], -1) if colour else np.ascontiguousarray(pixels)
    # cv2.imwrite does not notice a full disk at the end of a PNG, which may be all of it.
    encoded = cv2.imencode(path.suffix, as_stored, JPEG_OPTIONS if path.suffix == ".jpg" else [])[1].tobytes()
    try:
        path.write_bytes(encoded)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
