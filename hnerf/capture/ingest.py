"""Ingestion: a capture folder in any known layout becomes one normalised capture."""

import logging
import unicodedata
from contextlib import suppress
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np

from hnerf.capture.bars import Area, lens_for_area, picture_area
from hnerf.capture.board_footage import normalised_corners, read_board_footage
from hnerf.capture.capture import GIVEN_HANDS, KEYPOINTS, Capture, SubjectPoint, stored_lens
from hnerf.capture.clocks import RATE_TOLERANCE, InStep, in_step, warn_if_uneven
from hnerf.capture.footage import Footage, Video, VideoFrame
from hnerf.capture.formats.caliscope import FILES as CALISCOPE_FILES
from hnerf.capture.formats.caliscope import Caliscope
from hnerf.capture.formats.colmap import Colmap
from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.formats.from_person import FromPerson
from hnerf.capture.formats.layout import Layout, StoredFrame
from hnerf.capture.formats.peoplesnapshot import PeopleSnapshot
from hnerf.capture.formats.pose2sim import Pose2Sim
from hnerf.capture.formats.videos import Videos
from hnerf.capture.formats.zjumocap import ZjuMocap
from hnerf.capture.keypoint_files import pad_hands, pad_people, read_results
from hnerf.capture.keypoint_sets import hands_of, to_body_25
from hnerf.capture.lens import Lens
from hnerf.capture.manifest import (
    NO_FRAME,
    CaptureManifest,
    capture_name,
    chosen_cameras,
    chosen_frames,
    read_manifest,
)
from hnerf.capture.normalise import Normaliser, has_soft_edges, kept_share, lost_share
from hnerf.capture.safe_io import (
    IMAGE_SUFFIXES,
    JSON_SUFFIXES,
    VIDEO_SUFFIXES,
    file_named,
    path_in_capture,
    read_image,
    shown,
)
from hnerf.capture.subset import write_points
from hnerf.capture.timing import median_step
from hnerf.capture.uncalibrated import Uncalibrated, cameras_without_calibration, image_folders_in, videos_in
from hnerf.capture.video_metadata import is_hdr
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.progress import tracked

DEFAULT_FPS = 30.0  # of images, whose files state none
# Encoders pad and crop by a few pixels; the calibration stage judges what that does to the cameras.
SIZE_TOLERANCE = 0.02
MIN_KEPT_SHARE = 0.5  # of an undistorted image: a lens loses less than a fifth of it
IMPLAUSIBLE_LOSS = 0.9  # of a recorded image; an equidistant fisheye of 220 degrees loses 0.67
MAX_LOST_SHARE = 0.05  # of a recorded image, by undistortion: a wider border can hold hands or feet
MAX_MISPLACED_SHARE = 0.5  # of keypoints outside their images (detectors guess some there) or in the first pixel
LAYOUTS: tuple[type[Layout], ...] = (
    ZjuMocap,
    PeopleSnapshot,
    EasyMocap,
    Colmap,
    Caliscope,
    Pose2Sim,
    Videos,
)  # the first that recognises a folder is used
BLACK = 8  # grey level up to which noise and encoding can raise black
MAX_NAMED = 5  # in a warning
BY_CAMERA = ("images", "openpose", "masks", "mask", "background")  # folders of EasyMocap
READ_SUFFIXES = VIDEO_SUFFIXES + IMAGE_SUFFIXES + JSON_SUFFIXES
BAR_FRAMES = 5  # evenly spaced frames in which black bars are searched for

log = logging.getLogger("hnerf.capture")


def ingest(folder: Path, settings: CaptureSettings, out: Path, layout: Layout | None = None) -> Capture:
    """Read a capture folder, or one video, and write it normalised into `out`. layout: None to recognise it.

    Images are undistorted, and shrunk to `settings.max_side_px`, with their keypoints and masks. If `capture.toml`
    names no frames, those before the first and after the last detected person are left out. An `uncalibrated` recording
    is read without camera poses and board footage; all its cameras are then for training. Raises InputError, one line
    that names the file, on anything missing, unreadable, contradictory or unsafe.
    """
    layout = layout or recognise(folder)
    lenses, calibrated = layout.lenses(), not isinstance(layout, Uncalibrated)
    if calibrated:
        _warn_of_unread(folder, ("keypoints",), set(lenses))
    if isinstance(layout, EasyMocap):
        places = BY_CAMERA if isinstance(layout, Videos) else (*BY_CAMERA, "videos")  # a lone video can have any name
        _warn_of_unread(folder, places, set(lenses))
        _warn_of_unread(folder, ("pose",), {f"{name}_json" for name in lenses})
    manifest = _manifest_for(layout, folder)
    subject = capture_name(folder, manifest)
    cameras = chosen_cameras(folder, manifest, list(lenses), layout.training_cameras())
    filmed = {name: layout.footage(name) for name in cameras.train + cameras.test}
    clocks = {} if len(filmed) == 1 else layout.clocks()
    footage = in_step(filmed, clocks, manifest.fps or DEFAULT_FPS)
    if len(filmed) == 1 and calibrated:
        warn_if_uneven(*filmed.values())
    _warn_of_hdr(filmed)
    recorded, fps = _common_frames(footage), _frame_rate(folder, manifest.fps, filmed, footage)
    _check_subject(folder, manifest, {name: {*recorded, *filmed[name].frames} for name in cameras.train})
    detected = {name: detections(layout, name, one.source) for name, one in footage.items()}
    people = {name: footage[name].resampled(found) for name, found in detected.items() if found is not None}
    seen = [people[name] for name in cameras.train if name in people]
    occupied = recorded if manifest.frames else _frames_with_people(seen, recorded)
    frames = chosen_frames(folder, manifest, occupied, layout.novel_pose_share, settings.max_frames)
    wanted = tuple(sorted(frames.train + frames.novel_pose))

    out.mkdir(parents=True, exist_ok=True)
    written = {name: _write_camera(layout, lenses[name], one, wanted, settings, out) for name, one in footage.items()}
    normalisers = {name: normaliser for name, (normaliser, _) in written.items()}
    rows = np.searchsorted(recorded, wanted)
    people = {name: found[rows] for name, found in people.items()}
    hands = {name: points for name, found in people.items() if (points := hands_of(found)) is not None}
    for file, chosen in ((KEYPOINTS, to_body_25(people, manifest.keypoints)), (GIVEN_HANDS, hands)):
        write_points(out / file, {name: normalisers[name].keypoints(points) for name, points in chosen.items()})
    _write_given_poses(folder, layout, wanted, out)
    if calibrated and (boards := read_board_footage(folder, "extrinsic")):
        normalised_corners(boards, normalisers).save(out)

    metres = manifest.metres_per_unit
    capture = Capture(
        name=subject,
        root=out,
        cameras={name: replace(n.camera, t_m=n.camera.t_m * metres) for name, n in normalisers.items()},
        train_cameras=tuple(cameras.train),
        test_cameras=tuple(cameras.test),
        train_frames=tuple(sorted(frames.train)),
        novel_pose_frames=tuple(sorted(frames.novel_pose)),
        fps=fps,
        up=manifest.up,
        calibrated_sizes_px={name: lenses[name].size_px or n.recorded_size_px for name, n in normalisers.items()},
        recorded_sizes_px={name: n.recorded_size_px for name, n in normalisers.items()},
        picture_areas_px={name: area for name, (_, area) in written.items() if area},
        frame_step=median_step(recorded),
        subject_point=_subject_point(manifest, normalisers, wanted),
        stature_m=manifest.stature_m,
        notes=tuple(layout.notes()),
        recorded_lenses={name: stored_lens(n.lens) for name, n in normalisers.items() if n.maps},
    )
    capture.save()
    return capture


def has_calibration(folder: Path) -> bool:
    """Return whether a folder holds a calibration of its cameras, readable or not."""
    return any(layout.recognises(folder) for layout in LAYOUTS if layout is not Videos)


def hiding_calibrations(folder: Path, new: Path) -> list[Path]:
    """Return the files of a capture folder that would be read instead of the calibration in folder `new` once that is
    copied into it."""
    easymocap = "[ei][xn]tri.yml"  # later commands read lenses from intri.yml alone, too
    marks = (ZjuMocap.mark, PeopleSnapshot.mark, easymocap, Colmap.mark, *CALISCOPE_FILES, Pose2Sim.mark)
    preceding = takewhile(lambda mark: not any(new.glob(mark)), marks)
    return [path for mark in preceding for path in sorted(folder.glob(mark))]


def lacks_calibration(folder: Path) -> bool:
    """Return whether a folder holds recordings of several cameras, of which `capture.toml` names not just one, and
    neither their calibration nor footage of a board to calibrate them with."""
    if has_calibration(folder) or path_in_capture(folder, "calibration", "extrinsic").exists():
        return False
    several = folder.is_dir() and len(image_folders_in(folder) or videos_in(folder)) > 1
    return several and len(cameras_without_calibration(folder)) != 1


def exported_lenses(folder: Path) -> list[Lens]:
    """Return the cameras of a capture folder for other tools: in metres and, if the calibration states no size, with
    that of their first image, if there is one. Raises InputError as `ingest` does."""
    layout, metres = recognise(folder), read_manifest(folder).metres_per_unit
    return [
        replace(lens, t_m=metres * lens.t_m, size_px=lens.size_px or _first_size(layout, name))
        for name, lens in layout.lenses().items()
    ]


def _first_size(layout: Layout, camera: str) -> tuple[int, int] | None:
    """Return the (width, height) of a camera's first image; None if there is none."""
    with suppress(InputError):
        footage = layout.footage(camera)
        return next(footage.read(footage.frames[:1])).size_px
    return None


def recognise(folder: Path) -> Layout:
    """Return the layout of a folder, or of one video. Raises InputError if it is none of LAYOUTS."""
    if not folder.exists():
        raise InputError(f"{folder}: no such folder or video; give the folder of a capture")
    for layout in LAYOUTS:
        if layout.recognises(folder):
            return layout(folder)
    cameras = cameras_without_calibration(folder)
    if len(cameras) == 1:
        raise InputError(
            f"{folder / 'images' / cameras[0]}: one camera without a calibration is read from a video only; make a "
            "video of its images, or add intri.yml and extri.yml"
        )
    if cameras:
        raise InputError(
            f"{folder}: no calibration of its cameras (extri.yml or another); find them with `hnerf calibrate "
            f"{folder}` from footage of a board, or with --from person"
        )
    raise InputError(
        f"{folder}: is none of these: EasyMocap (intri.yml, extri.yml, images/), Pose2Sim (calibration/Calib*.toml), "
        "COLMAP (sparse/), Caliscope (camera_array.toml), aniposelib (calibration.toml), ZJU-MoCap (annots.npy), "
        f"PeopleSnapshot (camera.pkl) or videos ({', '.join(VIDEO_SUFFIXES)}); see docs/formats.md"
    )


def _manifest_for(layout: Layout, folder: Path) -> CaptureManifest:
    """Read `capture.toml` for a recording in this layout, without the entries that cannot apply to it.

    For an uncalibrated recording, the camera split and a subject named by a point on the ground are dropped; if only
    one of its cameras is read, so are the frame split and a subject named in another camera. Raises InputError if `up`
    is not the vertical axis of the layout's own world.
    """
    manifest = read_manifest(folder)
    if isinstance(layout, FromPerson):
        check_world_of_person(folder, manifest)
    if isinstance(layout, PeopleSnapshot | Videos):
        _check_z_up(folder, manifest)
    if not isinstance(layout, Uncalibrated):
        return manifest
    dropped = {"cameras"} | ({"frames"} if layout.only else set())
    if (point := manifest.subject_point) and (not point.camera or layout.only not in (None, point.camera)):
        dropped.add("subject")
    return manifest.model_copy(update=dict.fromkeys(dropped))


def check_world_of_person(folder: Path, manifest: CaptureManifest) -> None:
    """Raise InputError if `capture.toml` states another world than that of cameras found from the person: Z up, in
    metres."""
    _check_z_up(folder, manifest)
    if manifest.metres_per_unit != 1:
        raise InputError(
            f"{folder / 'capture.toml'}: units: cameras found from the person are in metres; remove the line"
        )


def _check_z_up(folder: Path, manifest: CaptureManifest) -> None:
    if manifest.up != "z":
        raise InputError(f"{folder / 'capture.toml'}: up: without a calibration, Z is up; remove the line")


def _warn_of_hdr(filmed: dict[str, Footage]) -> None:
    for path in (one.path for one in filmed.values() if isinstance(one, Video) and is_hdr(one.path)):
        log.warning("%s: colours of HDR video are read as Rec. 709, and look wrong; convert them, or record SDR", path)


def _warn_of_unread(folder: Path, places: tuple[str, ...], expected: set[str]) -> None:
    """Warn about images, masks and other files in these places that are not named after a calibrated camera."""
    for place in places:
        found = path_in_capture(folder, place)
        entries = [p for p in sorted(found.iterdir()) if not p.name.startswith(".")] if found.is_dir() else []
        named = [path.name for path in entries if path.is_dir()]
        named += [path.stem for path in entries if path.suffix.lower() in READ_SUFFIXES]
        unread = [shown(name) for name in named if unicodedata.normalize("NFC", name) not in expected]
        if unread:
            some = ", ".join(unread[:MAX_NAMED]) + (", ..." if len(unread) > MAX_NAMED else "")
            log.warning("%s: %s not in the calibration, and not read; rename or remove them", found, some)


def _check_subject(folder: Path, manifest: CaptureManifest, recorded: dict[str, set[int]]) -> None:
    """Raise InputError if the point that names the subject is in no training camera, or in no recorded frame. recorded:
    by camera."""
    point = manifest.subject_point
    if point is None or not point.camera:
        return
    path = folder / "capture.toml"
    if point.camera not in recorded:
        raise InputError(f"{path}: subject: there is no training camera {point.camera}; correct it")
    frames = recorded[point.camera]
    if point.frame != NO_FRAME and point.frame not in frames:
        raise InputError(
            f"{path}: subject: frame {point.frame} is none of the recording's frames {min(frames)} to {max(frames)}; "
            "correct it"
        )


def _subject_point(
    manifest: CaptureManifest, normalisers: dict[str, Normaliser], frames: tuple[int, ...]
) -> SubjectPoint | None:
    """Return the point that names the subject, in pixels of the normalised image of the chosen frame nearest to its own
    (the first one if it names none). Raises InputError if the point is outside the image, or the lens's valid area of
    it."""
    point = manifest.subject_point
    if point is None or not point.camera:
        return point
    normaliser = normalisers[point.camera]
    width_px, height_px = normaliser.recorded_size_px
    if not (0 <= point.at[0] <= width_px and 0 <= point.at[1] <= height_px):
        raise InputError(
            f"capture.toml: subject: {point.at} is outside the pictures of camera {point.camera}, {width_px} x "
            f"{height_px} px; correct it"
        )
    x, y, pictured = normaliser.keypoints(np.array([*point.at, 1.0]))
    if not pictured:
        raise InputError(f"capture.toml: subject: {point.at} is beyond the lens of camera {point.camera}; correct it")
    frame = min(frames, key=lambda chosen: abs(chosen - point.frame))
    return SubjectPoint((float(x), float(y)), point.camera, frame)


def _common_frames(footage: dict[str, InStep]) -> tuple[int, ...]:
    """Return the frames of all cameras. Raises InputError if cameras differ in frames or frame rate."""
    (first_name, first), *others = footage.items()
    for _, other in others:
        if other.frames != first.frames:
            numbers = "other numbers" if len(other.frames) == len(first.frames) else f"{len(first.frames)}"
            raise InputError(
                f"{other.path}: {len(other.frames)} frames, but camera {first_name} has {numbers}; "
                "give all cameras the same frames, or run `hnerf synchronise`"
            )
        if first.fps and other.fps and abs(other.fps - first.fps) > RATE_TOLERANCE * first.fps:
            raise InputError(
                f"{other.path}: {other.fps:.4g} frames a second, but {first.path} has {first.fps:.4g}; "
                "export all videos at the same rate, or run `hnerf synchronise`"
            )
    return first.frames


def _frame_rate(folder: Path, stated: float | None, filmed: dict[str, Footage], footage: dict[str, InStep]) -> float:
    """Return the frame rate of the common frames.

    A rate stated in `capture.toml` applies to images, and overrides one that all videos share (slow motion). If rates
    differ, the frames of the slowest camera count; raises InputError if the stated rate is not the slowest video's.
    Warn if nothing states a rate.
    """
    if not stated and not any(one.fps for one in filmed.values()):
        log.warning(
            "%s: images state no frame rate: %g frames a second assumed; if that is wrong, set fps in capture.toml",
            folder,
            DEFAULT_FPS,
        )
    counted = min((one.fps for one in footage.values() if one.fps), default=stated or DEFAULT_FPS)
    most = (1 + RATE_TOLERANCE) * counted
    if all((one.fps or stated or DEFAULT_FPS) <= most for one in filmed.values()):
        return stated or counted
    if stated and all(one.fps for one in filmed.values()) and abs(stated - counted) > RATE_TOLERANCE * counted:
        raise InputError(
            f"{folder / 'capture.toml'}: fps: {stated:g}, but frames are counted by the slowest video, which has "
            f"{counted:.4g} a second; remove the line"
        )
    return counted


def _write_given_poses(folder: Path, layout: Layout, frames: tuple[int, ...], out: Path) -> None:
    """Write the given poses, if the recording has any. Raises InputError if none of these frames has one."""
    poses = layout.given_poses(frames)
    if poses and not poses.known.any():
        raise InputError(f"{folder}: none of the chosen frames has a given pose; choose others, or remove the poses")
    if poses:
        poses.save(out / "poses.npz")


def _write_camera(
    layout: Layout, lens: Lens, footage: InStep, frames: tuple[int, ...], settings: CaptureSettings, out: Path
) -> tuple[Normaliser, Area | None]:
    """Write images, masks and clean plate of one camera, all of the first image's size. Return its normaliser, and the
    area that the calibrated picture fills if black bars prove it."""
    log.info("camera %s: %d frames from %s", lens.name, len(frames), footage.path)
    lens, area, size_px = lens_as_recorded(lens, footage, frames)
    _check_distortion(footage.path, lens, size_px)
    normaliser = Normaliser.create(lens, size_px, settings.max_side_px)
    if masks := layout.mask_files(lens.name):
        own = footage.recorded(frames)
        found = _per_frame(masks, tuple(own.values()), footage.source.frames, "masks")
        masks = {frame: found[own[frame]] for frame in frames}
    brightest = 0
    for picture in tracked(footage.read(frames), f"camera {lens.name}", len(frames)):
        brightest = max(brightest, int(picture.rgb.max()))
        target = out / "images" / lens.name / f"{picture.frame:06d}"
        normaliser.write_image(picture.rgb, picture.file or footage.path, picture.file, target)
    if brightest <= BLACK:
        raise InputError(f"{footage.path}: all pictures are black; record again, or leave camera {lens.name} out")
    if masks:
        _write_masks(normaliser, masks, out / "masks" / lens.name)
    plate = layout.plate_file(lens.name)
    if plate:
        normaliser.write_image(read_image(plate), plate, plate, out / "background" / lens.name)
    return normaliser, area


def _write_masks(normaliser: Normaliser, masks: dict[int, StoredFrame], out: Path, soft: bool = False) -> None:
    """Write the masks of one camera, by frame. If one has soft edges, all of them are written again as soft."""
    for frame, mask in tracked(masks.items(), f"masks of camera {normaliser.lens.name}", len(masks)):
        recorded = mask.read()
        if not soft and has_soft_edges(recorded, mask.path):
            return _write_masks(normaliser, masks, out, soft=True)
        normaliser.write_mask(recorded, soft, mask.path, out / f"{frame:06d}.png")


def _check_distortion(footage: Path, lens: Lens, size_px: tuple[int, int]) -> None:
    """Raise InputError if most of the undistorted image of (width, height) pixels was never recorded, or if it lacks
    almost all of what was. Warn if it lacks much of it."""
    if not lens.distorts:
        return
    if (kept := kept_share(lens, size_px)) < MIN_KEPT_SHARE:
        raise InputError(
            f"{footage}: by the distortion of camera {lens.name}, {1 - kept:.0%} of the picture was never recorded; "
            "calibrate it again"
        )
    if (lost := lost_share(lens, size_px)) > IMPLAUSIBLE_LOSS:
        raise InputError(
            f"{footage}: undistortion of camera {lens.name} would cut off {lost:.0%} of the picture; give its K in "
            "pixels, or calibrate it again"
        )
    if lost > MAX_LOST_SHARE:
        log.warning(
            "%s: undistortion of camera %s cuts off the borders, %.0f %% of the picture; keep the person away from "
            "them, or film with a narrower lens",
            footage,
            lens.name,
            100 * lost,
        )


def lens_as_recorded(
    lens: Lens, footage: Footage | InStep, frames: tuple[int, ...]
) -> tuple[Lens, Area | None, tuple[int, int]]:
    """Return the lens for the recorded size, the area that the calibrated picture fills if black bars prove it, and the
    (width, height) that is recorded.

    Without such a proof the lens is unchanged. Raises InputError if the sizes then differ too much.
    """
    first = next(footage.read(frames[:1]))
    recorded_px = first.size_px
    if lens.size_px in (None, recorded_px):
        return lens, None, recorded_px
    chosen = set(evenly_spaced(frames, BAR_FRAMES))
    area = picture_area([p.rgb for p in footage.read(chosen) if p.size_px == recorded_px])
    matched_lens = lens_for_area(lens, area, recorded_px)
    if matched_lens:
        return matched_lens, area, recorded_px
    if any(abs(r - c) > SIZE_TOLERANCE * c for r, c in zip(recorded_px, lens.size_px, strict=True)):
        raise InputError(
            f"{first.file or footage.path}: is {recorded_px[0]} x {recorded_px[1]} px, but camera {lens.name} was "
            f"calibrated at {lens.size_px[0]} x {lens.size_px[1]}; export the footage at that size or calibrate again"
        )
    return lens, None, recorded_px


def _per_frame(
    files: dict[int, StoredFrame], wanted: tuple[int, ...], recorded: tuple[int, ...], what: str
) -> dict[int, StoredFrame]:
    """Return the files of the wanted frames, in their order. Raises InputError if there is not one for every recorded
    frame."""
    place = next(iter(files.values())).place
    if len(files) != len(recorded):
        nobody = " (an empty list of people where nobody is seen)" if what == "keypoints" else ""
        raise InputError(f"{place}: {len(files)} {what} for {len(recorded)} frames; give one for each{nobody}")
    for frame in wanted:
        if frame not in files:
            raise InputError(f"{place}: {what} of frame {frame} missing; give one for each image, of its number")
    return {frame: files[frame] for frame in wanted}


def detections(layout: Layout, camera: str, footage: Footage) -> np.ndarray | None:
    """Return detected keypoints (frames, most people, K, 3), zero for absent people and hands; None if there are none.

    They come from the layout's own files, else from a list of results in keypoints/<camera>.json. Raises InputError if
    they are not in pixels of the images.
    """
    recorded = footage.frames
    files = layout.keypoint_files(camera)
    results = file_named(layout.folder, camera, "keypoints", suffixes=JSON_SUFFIXES)
    if files:
        chosen = list(_per_frame(files, recorded, recorded, "keypoints").values())
        paths, people, place = [file.path for file in chosen], [file.read() for file in chosen], chosen[0].place
    elif results.is_file():
        paths, people, place = [results] * len(recorded), read_results(results, recorded), results
    else:
        return None
    people = pad_hands(people)
    count = next((p.shape[1] for p in people if len(p)), 0)
    for path, points in zip(paths, people, strict=True):
        if len(points) and points.shape[1] != count:
            raise InputError(f"{path}: {points.shape[1]} keypoints a person where others have {count}; detect again")
    stacked = pad_people([points.reshape(len(points), count, 3) for points in people])
    _check_in_pixels(place, stacked[stacked[..., 2] > 0][:, :2], next(footage.read(recorded[:1])))
    return stacked


def _check_in_pixels(place: Path, points: np.ndarray, picture: VideoFrame) -> None:
    """Raise InputError if most of a camera's keypoints (n, 2) cannot be in pixels of its images: they are outside, or
    in the first pixel, as coordinates from 0 to 1 would be."""
    size_px = np.array(picture.size_px)
    if not len(points):
        return
    misplaced = ((points < 0) | (points > size_px)).any(-1) | (points <= 1).all(-1)
    if misplaced.mean() > MAX_MISPLACED_SHARE:
        spans = " and ".join(f"{low:.4g} to {high:.4g}" for low, high in zip(points.min(0), points.max(0), strict=True))
        raise InputError(
            f"{place}: keypoints from {spans} are not in the pixels of pictures of {size_px[0]} x {size_px[1]}; "
            "detect them in these pictures, or scale them"
        )


def _frames_with_people(people: list[np.ndarray], frames: tuple[int, ...]) -> tuple[int, ...]:
    """Return the frames from the first to the last in which any camera saw anybody: others have no pose to find.
    people: per camera (frames, people, K, 3). Return all frames if nobody was ever seen, which the calibration stage
    reports."""
    seen = np.flatnonzero(np.any([(found[..., 2] > 0).any((1, 2)) for found in people], axis=0))
    if not people or not len(seen):
        return frames
    before, after = frames[: seen[0]], frames[seen[-1] + 1 :]
    for empty, why in ((before, "nobody is there yet"), (after, "nobody is there any more")):
        if empty:
            log.warning("frames %d to %d left out: %s", empty[0], empty[-1], why)
    return frames[seen[0] : seen[-1] + 1]
