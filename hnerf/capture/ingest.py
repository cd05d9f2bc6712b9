"""The door: a capture folder in any known layout becomes one normalised capture."""

import logging
from pathlib import Path

import numpy as np

from hnerf.capture.camera import Camera
from hnerf.capture.capture import Capture
from hnerf.capture.footage import Footage
from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.formats.layout import Layout, read_openpose
from hnerf.capture.formats.pose2sim import Pose2Sim
from hnerf.capture.lens import Lens
from hnerf.capture.normalise import Normaliser
from hnerf.capture.notes import Notes, capture_name, chosen_cameras, chosen_frames, read_notes
from hnerf.config import CaptureSettings
from hnerf.errors import CaptureError

DEFAULT_FPS = 30.0
# Padding and cropping by encoders moves sizes by a few pixels; the calibration stage judges what it did to the cameras.
SIZE_TOLERANCE = 0.02

log = logging.getLogger("hnerf.capture")


def ingest(folder: Path, settings: CaptureSettings, out: Path) -> Capture:
    """Read a capture folder (EasyMocap or Pose2Sim layout) and write it normalised into `out`.

    Images are undistorted, and shrunk to `settings.max_side_px`; keypoints and masks with them. CaptureError, one line
    that names the file, on anything missing, unreadable, contradictory or unsafe.
    """
    layout, notes = recognise(folder), read_notes(folder)
    subject = capture_name(folder, notes)
    lenses = layout.lenses()
    cameras = chosen_cameras(folder, notes, list(lenses))
    footage = {name: layout.footage(name) for name in cameras.train + cameras.test}
    recorded = _common_frames(footage)
    frames = chosen_frames(folder, notes, recorded, layout.novel_pose_share, settings.max_frames)
    wanted = tuple(sorted(frames.train + frames.novel_pose))

    out.mkdir(parents=True, exist_ok=True)
    normalisers: dict[str, Normaliser] = {}
    keypoints: dict[str, np.ndarray] = {}
    for name in footage:
        log.info("camera %s: %d frames from %s", name, len(wanted), footage[name].path)
        normalisers[name] = _write_pixels(layout, lenses[name], footage[name], wanted, settings, out)
        files = layout.keypoint_files(name)
        if files:
            paths = _per_frame(files, wanted, recorded, "keypoints").values()
            detected = _stack([read_openpose(path) for path in paths])
            keypoints[name] = normalisers[name].keypoints(layout.to_body_25(detected))
    if keypoints:
        np.savez_compressed(out / "keypoints.npz", **keypoints)  # type: ignore[arg-type]

    capture = Capture(
        name=subject,
        root=out,
        cameras={name: _in_metres(n.camera, notes) for name, n in normalisers.items()},
        train_cameras=tuple(cameras.train),
        test_cameras=tuple(cameras.test),
        train_frames=tuple(frames.train),
        novel_pose_frames=tuple(frames.novel_pose),
        fps=notes.fps or next(iter(footage.values())).fps or DEFAULT_FPS,
        up=notes.up,
        calibrated_sizes_px={name: lenses[name].size_px or n.recorded_size_px for name, n in normalisers.items()},
        recorded_sizes_px={name: n.recorded_size_px for name, n in normalisers.items()},
    )
    capture.save()
    return capture


def recognise(folder: Path) -> Layout:
    """The folder's layout; CaptureError if it is none that is known."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give the folder of a capture")
    for layout in (EasyMocap, Pose2Sim):
        if layout.recognises(folder):
            return layout(folder)
    raise CaptureError(
        f"{folder}: neither EasyMocap (intri.yml, extri.yml, images/) nor Pose2Sim (calibration/, videos/); "
        "see docs/formats.md"
    )


def _common_frames(footage: dict[str, Footage]) -> tuple[int, ...]:
    (first_name, first), *others = footage.items()
    for _, other in others:
        if other.frames != first.frames:
            numbers = "other numbers" if len(other.frames) == len(first.frames) else f"{len(first.frames)}"
            raise CaptureError(
                f"{other.path}: {len(other.frames)} frames, but camera {first_name} has {numbers}; "
                "give all cameras the same frames"
            )
    return first.frames


def _write_pixels(
    layout: Layout, lens: Lens, footage: Footage, frames: tuple[int, ...], settings: CaptureSettings, out: Path
) -> Normaliser:
    """Images, masks and clean plate of one camera, all of the first image's size."""
    normaliser: Normaliser | None = None
    masks = layout.mask_files(lens.name)
    mask_paths = _per_frame(masks, frames, footage.frames, "masks") if masks else {}
    for picture in footage.read(frames):
        source = picture.file or footage.path
        if normaliser is None:
            height_px, width_px = picture.rgb.shape[:2]
            _check_against_calibration(source, (width_px, height_px), lens)
            normaliser = Normaliser.create(lens, (width_px, height_px), settings.max_side_px)
        stem = f"{picture.frame:06d}"
        normaliser.write_image(picture.rgb, source, picture.file, out / "images" / lens.name / stem)
        if picture.frame in mask_paths:
            normaliser.write_mask(mask_paths[picture.frame], out / "masks" / lens.name / f"{stem}.png")
    assert normaliser is not None  # a split has at least one training frame
    plate = layout.plate_file(lens.name)
    if plate:
        normaliser.write_plate(plate, out / "background" / lens.name)
    return normaliser


def _check_against_calibration(source: Path, recorded: tuple[int, int], lens: Lens) -> None:
    if lens.size_px is None:
        return
    if any(abs(r - c) > SIZE_TOLERANCE * c for r, c in zip(recorded, lens.size_px, strict=True)):
        raise CaptureError(
            f"{source}: is {recorded[0]} x {recorded[1]} px, but camera {lens.name} was calibrated at "
            f"{lens.size_px[0]} x {lens.size_px[1]}; export the footage at that size or calibrate again"
        )


def _per_frame(
    files: dict[int, Path], wanted: tuple[int, ...], recorded: tuple[int, ...], what: str
) -> dict[int, Path]:
    """The files of the wanted frames, in their order; CaptureError if there is not one for every recorded frame."""
    some = next(iter(files.values()))
    if len(files) != len(recorded):
        raise CaptureError(f"{some.parent}: {len(files)} {what} for {len(recorded)} frames; give one file a frame")
    for frame in wanted:
        if frame not in files:
            raise CaptureError(f"{some.parent}: {what} of frame {frame} missing; give one file a frame")
    return {frame: files[frame] for frame in wanted}


def _stack(people: list[np.ndarray]) -> np.ndarray:
    """Ragged (people, 25, 3) per frame to (frames, most people, 25, 3), absent ones zero."""
    stacked = np.zeros((len(people), max(1, *(len(p) for p in people)), 25, 3))
    for row, points in zip(stacked, people, strict=True):
        row[: len(points)] = points
    return stacked


def _in_metres(camera: Camera, notes: Notes) -> Camera:
    metres_per_unit = {"m": 1.0, "mm": 1e-3}[notes.units]
    return Camera(camera.name, camera.K, camera.R, camera.t_m * metres_per_unit, camera.width_px, camera.height_px)
