"""`hnerf render` on an untrained subject: a column whose field is as initialised, except for frames that deform it."""

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from flows.cli import main
from hnerf.avatar.model_file import write_field
from hnerf.avatar.trained import build_field, load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.footage import Video
from hnerf.capture.formats.export import write_cameras
from hnerf.capture.lens import Lens
from hnerf.config import load_settings
from hnerf.progress import Progress, listening
from hnerf.render.motion import interpolate_poses
from hnerf.render.subject import RenderOptions, _cameras
from tests.training.scene import tiny


@pytest.fixture
def copy(subject: Path, tmp_path: Path) -> Path:
    """Return a copy of the subject, to be damaged."""
    return shutil.copytree(subject, tmp_path / "copy")


@pytest.fixture
def refusal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return a function that renders, checks that it is refused without output, and returns the one error line."""

    def refused(subject: Path, *options: str) -> str:
        assert main(["render", str(subject), "--out", str(tmp_path / "out"), *options]) == 2
        assert not (tmp_path / "out").exists()
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return refused


def numbers(out: Path, kind: str) -> list[str]:
    return sorted(path.stem for path in (out / kind).iterdir())


def test_a_recorded_camera_shows_every_fitted_frame(subject: Path, tmp_path: Path) -> None:
    assert main(["render", str(subject), "--camera", "2", "--out", str(tmp_path / "out"), "--what", "colour,mask"]) == 0
    assert numbers(tmp_path / "out", "mask") == ["000000", "000001", "000002"]
    avatar = load_avatar(subject / "training", "cpu")
    camera = Capture.load(subject / "capture").cameras["2"]
    for row in range(3):
        rgb = avatar.render(camera, avatar.body.theta[row], avatar.body.root[row]).rgb
        expected = (255 * rgb).round().numpy()
        found = cv2.imread(str(tmp_path / "out" / "colour" / f"{row:06d}.png"))
        assert expected.max() > 50
        np.testing.assert_allclose(found[..., ::-1], expected, atol=1)
    video = Video.open(tmp_path / "out" / "colour.mp4")
    assert (len(video.frames), video.fps) == (3, 10.0)
    assert not (tmp_path / "out.partial").exists()


def test_a_recorded_frame_keeps_its_deformation_and_interpolated_poses_have_none(subject: Path, tmp_path: Path) -> None:
    """Frames 1 and 2 are displaced by 15 cm, 1.4 pixels, to either side of their poses. Poses interpolated between them
    are not displaced, not even the first and the last; otherwise these would jump."""
    arguments = {"alone": ["--frames", "1"], "between": ["--between", "1", "2", "--pictures", "3"]}
    for name, options in arguments.items():
        view = ["--camera", "0", "--what", "colour", *options]
        assert main(["render", str(subject), "--out", str(tmp_path / name), *view]) == 0
    avatar = load_avatar(subject / "training", "cpu")
    camera = Capture.load(subject / "capture").cameras["0"]
    halfway = interpolate_poses(avatar.body, 1, 2, 3)
    expected = {
        "alone/colour/000000.png": avatar.render(camera, avatar.body.theta[1], avatar.body.root[1]),
        "between/colour/000001.png": avatar.without_frames().render(camera, halfway.theta[1], halfway.root[1]),
        "between/colour/000002.png": avatar.without_frames().render(camera, halfway.theta[2], halfway.root[2]),
    }
    for path, rendering in expected.items():
        found = cv2.imread(str(tmp_path / path))
        np.testing.assert_allclose(found[..., ::-1], (255 * rendering.rgb).round().numpy(), atol=1)
    with_none = avatar.without_frames().render(camera, avatar.body.theta[1], avatar.body.root[1])
    assert (with_none.alpha - expected["alone/colour/000000.png"].alpha).abs().max() > 0.3


def test_every_second_frame_lasts_twice_as_long(subject: Path, tmp_path: Path) -> None:
    options = ["--camera", "0", "--what", "mask", "--frames", "::2"]
    assert main(["render", str(subject), "--out", str(tmp_path / "out"), *options]) == 0
    video = Video.open(tmp_path / "out" / "mask.mp4")
    assert (len(video.frames), video.fps) == (2, 5.0)  # recorded at 10 a second


def test_a_frame_lasts_until_the_next_one(copy: Path, tmp_path: Path) -> None:
    """Of frames 0, 2 and 3, recorded at 10 a second, the first lasts twice as long as the others."""
    body = BodyFit.load(copy / "training")
    dataclasses.replace(body, frames=(0, 2, 3)).save(copy / "training")
    assert main(["render", str(copy), "--camera", "0", "--what", "mask", "--out", str(tmp_path / "out")]) == 0
    assert numbers(tmp_path / "out", "mask") == ["000000", "000001", "000002"]
    video = Video.open(tmp_path / "out" / "mask.mp4")
    assert (len(video.frames), video.fps) == (4, 10.0)
    first, second, third, last = (picture.rgb.astype(int) for picture in video.read(range(4)))
    assert abs(first - second).max() < 32 < min(abs(second - third).max(), abs(third - last).max())


def test_the_size_sets_the_longer_side(subject: Path) -> None:
    capture, body = Capture.load(subject / "capture"), BodyFit.load(subject / "training")
    wide = dataclasses.replace(capture, cameras=capture.cameras | {"2": capture.cameras["2"].resized(80, 40)})
    (found,) = _cameras(RenderOptions(camera="2", size_px=20, pictures=1), wide, body)
    assert found.size_px == (20, 10)


def test_an_orbit_around_one_pose_has_the_requested_size_and_number_of_images(subject: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--frames", "1", "--pictures", "4", "--size", "48", "--what", "mask"]
    assert main(["render", str(subject), "--out", str(out), *options]) == 0
    masks = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((out / "mask").iterdir())]
    assert [mask.shape for mask in masks] == [(48, 48)] * 4
    for mask in masks:
        y, x = np.nonzero(mask > 127)
        assert abs((x.min() + x.max()) / 2 - 23.5) < 4  # seen in the middle, from all sides
        assert abs((y.min() + y.max()) / 2 - 23.5) < 4


def test_an_orbit_looks_at_the_middle_of_all_poses(subject: Path) -> None:
    """Bodies of 1 x 1 m stand at x = 0 to 1 m, and at 4 to 5 m: all cameras see 2.5 m in the middle of their images."""
    capture, body = Capture.load(subject / "capture"), BodyFit.load(subject / "training")
    root = torch.eye(4).repeat(2, 1, 1)
    root[1, 0, 3] = 4.0
    walked = dataclasses.replace(body, frames=(0, 1), theta=torch.zeros_like(body.theta[:2]), root=root)
    middle_m = np.array([2.5, 0.5, 1.0])
    for camera in _cameras(RenderOptions(pictures=3), capture, walked):
        size_px = np.array(camera.size_px)
        np.testing.assert_allclose(camera.project(middle_m)[0], (size_px - 1) / 2, atol=1e-3)


def test_a_camera_path_without_sizes_takes_the_size_of_the_recording(subject: Path, tmp_path: Path) -> None:
    """Intrinsics of a path are for images as recorded, not as downscaled by ingest."""
    capture = Capture.load(subject / "capture")
    lens = Lens("a", capture.cameras["2"].K, np.zeros(5), capture.cameras["2"].R, capture.cameras["2"].t_m, None)
    write_cameras(tmp_path / "path", [lens], "easymocap")
    shrunk = dataclasses.replace(capture, recorded_sizes_px=dict.fromkeys(capture.cameras, (500, 300)))
    (found,) = _cameras(RenderOptions(path=tmp_path / "path", pictures=1), shrunk, BodyFit.load(subject / "training"))
    assert found.size_px == (500, 300)


def test_virtual_cameras_have_no_exposure_gain(subject: Path) -> None:
    """An orbit copies the first camera, and cameras of a path may have any name: neither may use a recorded gain."""
    capture, body = Capture.load(subject / "capture"), BodyFit.load(subject / "training")
    assert not {camera.name for camera in _cameras(RenderOptions(), capture, body)} & set(capture.cameras)
    along_recorded = _cameras(RenderOptions(path=subject / "calibration"), capture, body)
    assert not {camera.name for camera in along_recorded} & set(capture.cameras)
    assert {camera.name for camera in _cameras(RenderOptions(camera="2"), capture, body)} == {"2"}


def test_progress_of_computing_the_box_of_a_motion_is_reported(subject: Path) -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        _cameras(RenderOptions(), Capture.load(subject / "capture"), BodyFit.load(subject / "training"))
    assert heard == [("box of the motion", done, 3) for done in range(4)]


def test_interpolated_poses_of_another_motion_are_rendered_along_a_path(subject: Path, tmp_path: Path) -> None:
    options = ["--between", "0", "2", "--pictures", "3", "--motion", str(subject), "--path", f"{subject}/calibration"]
    assert main(["render", str(subject), "--out", str(tmp_path / "out"), "--what", "depth", *options]) == 0
    assert len(numbers(tmp_path / "out", "depth")) == 3


def test_a_taller_body_reaches_higher_in_the_image(subject: Path, tmp_path: Path) -> None:
    tops = []
    for name, options in (("as_fitted", []), ("taller", ["--shape", "height=+0.4"])):
        out = tmp_path / name
        view = ["--camera", "0", "--frames", "0", "--what", "mask"]
        assert main(["render", str(subject), "--out", str(out), *view, *options]) == 0
        mask = cv2.imread(str(out / "mask" / "000000.png"), cv2.IMREAD_GRAYSCALE)
        tops.append(int(np.nonzero(mask.max(1) > 127)[0].min()))
    # 38.4 px focal length, 4 m away: 40 cm are about 4 pixels.
    assert 2 <= tops[0] - tops[1] <= 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--camera", "9"], "--camera 9: no such camera; there are 0, 1, 2, 3"),
        (["--what", "colour,xray"], "--what xray: choose from colour, depth, normals, mask, mesh"),
        (["--camera", "0", "--height", "1"], "--radius and --height are for an orbit"),
        (["--frames", "7"], "no frames 7; it has 0 to 2"),
        (["--frames", "0", "--between", "0", "2"], "--frames 0: has no effect with --between; leave it out"),
        (["--frames", "0", "--motion", "t-pose"], "--frames 0: has no effect with --motion t-pose; leave it out"),
        (["--between", "0", "7"], "no frames 7; it has 0 to 2"),
        (["--motion", "absent.npz"], "absent.npz: no such file"),
        (["--path", "absent.json"], "absent.json: no such file; give --path another"),
        (["--frames", "9" * 5000], "give a number like 12, or FIRST:END:STEP like 0:24:2"),
        (["--shape", "height"], "--shape height: give a name and what to add"),
        (["--shape", "height=nan"], "--shape height=nan: give a name and what to add"),
        (["--shape", "height=1", "--shape", "height=2"], "--shape height=1 --shape height=2: give each name once"),
        (["--volume", "-100"], "volume -100 %: cannot be reached with this body"),
    ],
)
def test_impossible_options_are_refused_in_one_line(
    options: list[str], message: str, subject: Path, tmp_path: Path, refusal: Callable[..., str]
) -> None:
    assert message in refusal(subject, *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [["--between", "0", "1"], ["--volume", "5"], ["--shape", "height=0.1"]])
def test_a_model_without_poses_shows_recorded_frames_only(
    options: list[str], copy: Path, refusal: Callable[..., str]
) -> None:
    stored = {"static": True, "training": load_settings("nerfies").training.model_dump()}
    (copy / "training" / "settings.json").write_text(json.dumps(stored))
    assert "copy: Nerfies has no pose to set" in refusal(copy, *options)


def test_a_model_without_poses_shows_the_frames_that_it_was_trained_on(
    copy: Path, tmp_path: Path, refusal: Callable[..., str]
) -> None:
    """Frame 2 is a new pose: evaluation has no picture of it, either."""
    settings, body = tiny("nerfies", pose_learning_rate=0.0), BodyFit.load(copy / "training")
    write_field(build_field(settings.field, body, False), copy / "training" / "model.safetensors")
    stored = {"static": False, "training": settings.model_dump()}
    (copy / "training" / "settings.json").write_text(json.dumps(stored))
    options = ["--size", "8", "--what", "mask"]
    assert main(["render", str(copy), "--out", str(tmp_path / "all"), *options]) == 0
    assert numbers(tmp_path / "all", "mask") == ["000000", "000001"]
    assert "copy: no frames 2; it has 0 to 1" in refusal(copy, "--frames", "2", *options)


def test_an_existing_folder_is_not_overwritten(
    subject: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["render", str(subject), "--out", str(tmp_path)]) == 2
    assert "exists; give the name of a new folder" in capsys.readouterr().err


def test_a_folder_without_a_subject_is_refused(tmp_path: Path, refusal: Callable[..., str]) -> None:
    assert "capture.json: missing; give <store>/subjects/<name>" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("file", "named"),
    [
        ("capture/capture.json", "capture/capture.json"),
        ("calibration/intri.yml", "calibration"),
        ("calibration/report.json", "calibration"),
        ("training/body.npz", "training"),
        ("training/rig.npz", "training"),
        ("training/settings.json", "training"),
        ("training/model.safetensors", "training"),
    ],
)
def test_a_subject_with_a_truncated_file_is_refused_in_one_line(
    file: str, named: str, copy: Path, refusal: Callable[..., str]
) -> None:
    (copy / file).write_bytes((copy / file).read_bytes()[: (copy / file).stat().st_size // 2])
    line = refusal(copy, "--camera", "0", "--frames", "0")
    assert line.startswith(f"hnerf: {copy / named}: damaged, or written by another version (")


def set_keys(subject: Path, camera: str = "", **changes: object) -> None:
    """Replace keys of a subject's capture, or of one of its cameras."""
    path = subject / "capture/capture.json"
    content = json.loads(path.read_text())
    (content["cameras"][camera] if camera else content).update(changes)
    path.write_text(json.dumps(content))


def replace_text(file: str, old: str, new: str, subject: Path) -> None:
    """Replace text in a file of a subject's calibration."""
    text = (subject / "calibration" / file).read_text()
    assert old in text
    (subject / "calibration" / file).write_text(text.replace(old, new, 1))


def nest_deeply(subject: Path) -> None:
    (subject / "calibration/intri.yml").write_text("a: " + "[" * 200_000)


NONSENSE = {
    "no training cameras": (partial(set_keys, train_cameras=[]), "capture.json: damaged"),
    "an unknown training camera": (partial(set_keys, train_cameras=["zz"]), "capture.json: damaged"),
    "no cameras": (partial(set_keys, cameras={}), "capture.json: damaged"),
    "an unknown axis": (partial(set_keys, up="w"), "(up: w)"),
    "a number as axis": (partial(set_keys, up=3), "(up: 3)"),
    "a word as frame rate": (partial(set_keys, fps="x"), "capture.json: damaged"),
    "a frame rate of zero": (partial(set_keys, fps=0), "(fps: 0)"),
    "words as size": (partial(set_keys, camera="2", size_px=["a", "b"]), "capture.json: damaged"),
    "an enormous size": (partial(set_keys, camera="2", size_px=[10**9, 10**9]), "capture.json: declares"),
    "a camera at NaN": (partial(set_keys, camera="2", t_m=[math.nan] * 3), "capture.json: camera 2: T holds a NaN"),
    "a K of one number": (partial(set_keys, camera="2", K=[[1]]), "capture.json: camera 2: K has 1 numbers"),
    "no K": (partial(replace_text, "intri.yml", "K_2:", "K_9:"), "calibration: damaged"),
    "no rotation": (partial(replace_text, "extri.yml", "Rot_2:", "Rot_9:"), "calibration: damaged"),
    "no names": (partial(replace_text, "intri.yml", "names:", "nam:"), "calibration: damaged"),
    "a small K": (
        partial(replace_text, "intri.yml", "rows: 3\n   cols: 3", "rows: 2\n   cols: 2"), "calibration: damaged"
    ),
    "deeply nested": (nest_deeply, "calibration: damaged"),
}  # fmt: skip


@pytest.mark.parametrize("case", NONSENSE)
def test_a_subject_with_invalid_values_is_refused_in_one_line(
    case: str, copy: Path, refusal: Callable[..., str]
) -> None:
    """Deep nesting overflows the stack of OpenCV's own parser."""
    damage, message = NONSENSE[case]
    damage(copy)
    line = refusal(copy, "--frames", "0", "--pictures", "1")
    assert line.startswith(f"hnerf: {copy}/") and message in line


@pytest.mark.parametrize(
    ("file", "name", "array", "message"),
    [
        ("rig.npz", "faces", np.zeros(3, int), "faces has shape (3,)"),
        ("rig.npz", "faces", np.full((1, 3), 10**6), "faces has an index beyond "),
        ("rig.npz", "joints_m", np.zeros((2, 4)), "joints_m has shape (2, 4)"),
        ("rig.npz", "parents", np.array([-1]), "parents has shape (1,)"),
        ("body.npz", "theta", np.zeros((1, 2, 3)), "theta (1, 2, 3), T "),
        ("body.npz", "T", np.zeros((4, 4)), ", T (4, 4) are not "),
    ],
)
def test_a_subject_with_inconsistent_arrays_is_refused_in_one_line(
    file: str, name: str, array: np.ndarray, message: str, copy: Path, refusal: Callable[..., str]
) -> None:
    with np.load(copy / "training" / file) as stored:
        np.savez(copy / "training" / file, **{**stored, name: array})
    line = refusal(copy)
    assert line.startswith(f"hnerf: {copy / 'training'}: damaged, or written by another version (") and message in line


def test_a_motion_of_another_version_is_refused_in_one_line(
    subject: Path, copy: Path, refusal: Callable[..., str]
) -> None:
    set_keys(copy, lens=1)
    line = refusal(subject, "--motion", str(copy))
    assert line.startswith(f"hnerf: {copy / 'capture/capture.json'}: damaged, or written by another version (")
