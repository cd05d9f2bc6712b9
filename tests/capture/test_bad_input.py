"""Damaged recordings are refused with a one-line message that names the file, before anything is written."""

import json
import os
import pickle
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import write_image
from tests.capture import recordings as rec
from tests.capture.test_safe_pickle import Bomb

Damage = Callable[[Path], object]
KEYPOINTS, TABLES = "openpose/01/000001_keypoints.json", "calibration/Calib.toml"


def _edited(name: str, old: str, new: str) -> Damage:
    """Return the damage of replacing a text in a file."""

    def damage(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return damage


def _written(name: str, content: str | bytes) -> Damage:
    """Return the damage of another content of a file."""
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def _shoulder(*point: float) -> Damage:
    """Return the damage of one keypoint in another place."""
    points = np.full((25, 3), 0.5)
    points[2] = point
    return lambda folder: rec.write_keypoints(folder / KEYPOINTS, [points])


def _scale_keypoints(factor: float) -> Damage:
    def damage(folder: Path) -> None:
        for path in (folder / "openpose/01").iterdir():
            rec.write_keypoints(path, [factor * np.tile([7.0, 5.0, 0.1], (25, 1))])

    return damage


def _link(folder: Path, name: str) -> None:
    target = folder.parent / "elsewhere"
    (folder / name).rename(target)
    (folder / name).symlink_to(target)


def _huge_png(folder: Path) -> None:
    """Write a PNG whose header, with its checksum, claims 7000 x 7000 pixels, which Pillow itself accepts."""
    path = folder / "images/02/000003.png"
    data = bytearray(path.read_bytes())
    data[16:24] = (7000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    path.write_bytes(data)


def _pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def _file_in_place_of(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.write_text("not a folder")


def _toml(text: str) -> Damage:
    return _written("capture.toml", text)


def _call_a_camera_file(folder: Path) -> None:
    for path in (folder / "intri.yml", folder / "extri.yml"):
        path.write_text(path.read_text().replace('"01"', '"file"').replace("_01:", "_file:"))


EASYMOCAP = {
    "extri missing": (lambda f: (f / "extri.yml").unlink(), "walker: no calibration of its cameras (extri.yml or"),
    "intri is a pickle": (_written("intri.yml", pickle.dumps(Bomb())), "intri.yml: is not UTF-8 text"),
    "intri is an ASCII pickle": (_written("intri.yml", pickle.dumps(Bomb(), 0)), "intri.yml: not an OpenCV YAML"),
    "intri is deeply nested": (_written("intri.yml", "%YAML:1.0\n---\na: " + "[" * 5000), "(nested more than 32"),
    "NaN in K": (_edited("intri.yml", "20.", ".Nan"), "intri.yml: K_01"),
    "NaN in T": (_edited("extri.yml", "data: [ 0., 1., 3. ]", "data: [ .Nan, 1., 3. ]"), "extri.yml: T_01"),
    "plain nan in K": (_edited("intri.yml", "20.", "nan"), "intri.yml: camera 01: K"),
    "zero focal length in K": (_edited("intri.yml", "20.", "0."), "intri.yml: camera 01: K"),
    "aliases in intri": (
        _edited("intri.yml", "names:", f"a: &a [{'x,' * 9}]\nb: &b [{'*a,' * 9}]\nnames: [*b]\nc:"),
        "intri.yml: not an OpenCV YAML file (aliases",
    ),
    "key twice in intri": (_edited("intri.yml", "names:", "W_01: 12\nnames:"), "there twice"),
    "camera names that are lists": (_edited("intri.yml", '"01"', '["01"]'), "intri.yml: camera name that is no"),
    "camera name with a terminal escape sequence": (
        _edited("intri.yml", '"01"', f'"\\e[2J{"a" * 500}"'),
        "intri.yml: camera name '\\x1b[2Jaaaa",
    ),
    "camera named twice": (_edited("intri.yml", '"02"', '"01"'), "two cameras are called 01"),
    "T of 1e30": (_edited("extri.yml", "data: [ 0., 1., 3. ]", "data: [ 1e30, 1., 3. ]"), "T holds 1e+30"),
    "distortion beyond any lens": (
        lambda f: rec.write_calibration(f, (1e8, 0, 0, 0, 0)),
        "images/01: by the distortion of camera 01",
    ),
    "camera not in extri": (_edited("extri.yml", "T_02", "T_03"), "extri.yml: T_02"),
    "matrix of a billion rows": (_edited("intri.yml", "rows: 3", "rows: 1000000000"), "intri.yml: K_01"),
    "matrix shorter than declared": (_edited("intri.yml", "cols: 3", "cols: 5"), "intri.yml: K_01"),
    "intri of a gigabyte": (lambda f: os.truncate(f / "intri.yml", 10**9), "intri.yml: 1000000000 bytes are"),
    "camera name leaves the folder": (_edited("intri.yml", '"01"', '"../01"'), "intri.yml: camera name '../01'"),
    "camera named like an argument of np.savez": (_call_a_camera_file, "intri.yml: a camera cannot be"),
    "camera without a folder": (lambda f: (f / "images/02").rename(f / "images/03"), "images/02: no JPEG or PNG"),
    "camera without images": (
        lambda f: [p.unlink() for p in (f / "images/02").iterdir()],
        "add them, or leave the camera out of [cameras] in capture.toml",
    ),
    "unequal frame counts": (lambda f: (f / "images/02/000002.png").unlink(), "02: 4 frames, but camera 01 has 5"),
    "frame without a number": (lambda f: (f / "images/01/000001.png").rename(f / "images/01/a.png"), "a.png: images"),
    "unreadable image": (_written("images/01/000001.png", b"nothing"), "images/01/000001.png: not a readable image"),
    "image cut short": (lambda f: os.truncate(f / "images/01/000001.png", 700), "image file is truncated"),
    "all images are black": (
        lambda f: [write_image(p, np.full((16, 24, 3), 5, np.uint8)) for p in (f / "images/02").iterdir()],
        "images/02: all pictures are black",
    ),
    "image of enormous size": (_huge_png, "images/02/000003.png: declares 7000 x 7000 px"),
    "image of a gigabyte": (
        lambda f: os.truncate(f / "images/02/000003.png", 10**9),
        "images/02/000003.png: 1000000000 bytes are too many",
    ),
    "image of another size": (
        lambda f: write_image(f / "images/01/000002.png", np.zeros((8, 8, 3), np.uint8)),
        "images/01/000002.png: is 8 x 8 px",
    ),
    "calibrated at another size": (_edited("intri.yml", "W_02: 24", "W_02: 32"), "24 x 16 px, but camera 02"),
    "two plates of one camera": (
        lambda f: [write_image(f / "background" / name, rec.picture("01", 0)) for name in ("01.jpg", "01.png")],
        "background/01.png: camera 01 is also 01.jpg; keep one of them",
    ),
    "plate of another size": (
        lambda f: write_image(f / "background/01.png", np.zeros((8, 8, 3), np.uint8)),
        "background/01.png: is 8 x 8 px, but",
    ),
    "mask missing": (
        lambda f: write_image(f / "masks/01/000002.png", np.zeros((16, 24, 3), np.uint8)),
        "masks/01: 1 masks for 5 frames",
    ),
    "empty keypoint file": (_written(KEYPOINTS, ""), "000001_keypoints.json: is empty"),
    "keypoint file missing": (
        lambda f: (f / KEYPOINTS).unlink(),
        "openpose/01: 4 keypoints for 5 frames; give one for each (an empty list of people where nobody is seen)",
    ),
    "keypoints are a pickle": (_written(KEYPOINTS, pickle.dumps(Bomb())), "000001_keypoints.json: is not UTF-8"),
    "keypoints are an archive": (
        lambda f: np.savez(open(f / KEYPOINTS, "wb"), a=1),  # noqa: SIM115
        "000001_keypoints.json: is not UTF-8",
    ),
    "keypoints of another model": (
        lambda f: rec.write_keypoints(f / KEYPOINTS, [np.zeros((18, 3))]),
        "18 keypoints a person where others have 25",
    ),
    "keypoint with too many digits": (
        _edited(KEYPOINTS, "4.0", "9" * 400),
        "000001_keypoints.json: keypoints are not triples of numbers",
    ),
    "keypoints are deeply nested": (_written(KEYPOINTS, "[" * 100_000), "000001_keypoints.json: is not JSON"),
    "keypoints as fractions of the image size": (
        _scale_keypoints(0.1),
        "openpose/01: keypoints from 0.7 to 0.7 and 0.5 to",
    ),
    "keypoints as fractions of the image size, one below the border": (
        lambda f: [_scale_keypoints(0.1)(f), _edited(KEYPOINTS, "0.5", "1.02")(f)],
        "openpose/01: keypoints from 0.7 to 0.7 and 0.5 to 1.02 are not in the pixels",
    ),
    "keypoints of larger images": (_scale_keypoints(4), "not in the pixels of pictures of 24 x 16"),
    "keypoint whose mean with another overflows": (
        _shoulder(1e308, 1e308, 1),
        "000001_keypoints.json: a keypoint is beyond 1e+06",
    ),
    "NaN keypoint": (_shoulder(np.nan, 0.5, 0.5), "000001_keypoints.json: a keypoint is NaN"),
    "a thousand people": (_written(KEYPOINTS, json.dumps({"people": [{}] * 1000})), "1000 people"),
    "file in place of the keypoints' folder": (
        lambda f: _file_in_place_of(f / "openpose"),
        "openpose: is a file where a folder belongs",
    ),
    "file in place of one camera's keypoints": (
        lambda f: _file_in_place_of(f / "openpose/02"),
        "openpose/02: is a file where a folder belongs",
    ),
    "linked image folder": (lambda f: _link(f, "images/01"), "images/01: is a symbolic link"),
    "linked image": (lambda f: _link(f, "images/01/000001.png"), "000001.png: is a symbolic link"),
    "linked calibration": (lambda f: _link(f, "intri.yml"), "intri.yml: is a symbolic link"),
    "pipe in place of extri": (lambda f: _pipe(f / "extri.yml"), "extri.yml: is a pipe or a device"),
    "pipe in place of capture.toml": (lambda f: _pipe(f / "capture.toml"), "capture.toml: is a pipe or a device"),
    "pipe in place of an image": (lambda f: _pipe(f / "images/01/000001.png"), "000001.png: is a pipe or a device"),
    "toml with a key of many parts": (_toml("a." * 20_000 + "b = 1\n"), "capture.toml: a key has more than 16 parts"),
    "toml beyond 64 KiB": (_toml("# " + "a" * 70_000), "capture.toml: 70002 bytes are too many"),
    "toml with an integer of 5000 digits": (
        _toml("fps = " + "9" * 5000),
        "capture.toml: is not TOML (Exceeds the limit",
    ),
    "toml with an integer of 4000 digits": (_toml("fps = " + "9" * 4000), "capture.toml: fps"),
    "toml with a frame rate near zero": (_toml("fps = 1e-300"), "capture.toml: fps"),
    "toml with a unit near zero": (_toml("units = 1e-300"), "capture.toml: units"),
    "toml is not TOML": (_toml("name = "), "capture.toml: is not TOML"),
    "toml with an unknown key": (_toml('[cameras]\ntrain = ["01"]\nvalidation = ["02"]\n'), "cameras.validation"),
    "toml with cameras outside their table": (
        _toml('train = ["01"]\ntest = ["02"]\n'),
        "capture.toml: test is in no table; put it under [cameras]",
    ),
    "toml with frames outside their table": (_toml("novel_pose = [3]\n"), "novel_pose is in no table; put it under [f"),
    "toml with unknown units": (_toml('units = "inch"\n'), 'units: give "m", "mm"'),
    "toml with a mistyped table": (_toml('[Camera]\ntrain = ["01"]\n'), "Camera has no meaning; did you mean cameras?"),
    "toml with a mistyped key": (_toml('unit = "mm"\n'), "unit has no meaning; did you mean units?"),
    "toml in another encoding": (_written("capture.toml", b'name = "J\xfcrgen"'), "is not UTF-8"),
    "toml name too long for a folder": (_toml(f'name = "{100 * "张"}"\n'), "name of 300 bytes"),
    "toml with an infinite unit": (_toml("units = inf\n"), 'units: give "m", "mm", or a number'),
    "toml with an unknown camera": (_toml('[cameras]\ntrain = ["01", "07"]\n'), "camera 07"),
    "toml with a camera twice": (_toml('[cameras]\ntrain = ["01"]\ntest = ["01"]\n'), "named twice"),
    "toml with an unknown frame": (_toml("[frames]\ntrain = [0, 5]\n"), "frame 5"),
    "toml without training frames": (_toml("[frames]\ntrain = []\n"), "frames.train"),
    "toml with a subject that cannot be read": (_toml('subject = "nearest (1, 2)"\n'), 'subject: write "near'),
    "toml with a subject too far away": (_toml(f'subject = "nearest to ({"9" * 400}, 1)"\n'), 'subject: write "near'),
    "toml with a subject in a frame that was not recorded": (
        _toml('subject = "nearest to (1, 2) in 01 at frame 999"\n'),
        "capture.toml: subject: frame 999 is none of the recording's frames 0 to 4; correct it",
    ),
    "toml with a subject beyond what the lens can image": (
        lambda f: [rec.write_calibration(f, (-0.5, 0, 0, 0)), _toml('subject = "nearest to (0, 0) in 01"\n')(f)],
        "capture.toml: subject: (0.0, 0.0) is beyond the lens of camera 01; correct it",
    ),
    "toml with a subject outside the pictures": (
        _toml('subject = "nearest to (31, 7) in 01"\n'),
        "capture.toml: subject: (31.0, 7.0) is outside the pictures of camera 01, 24 x 16 px; correct it",
    ),
    "toml with a subject below the pictures": (
        _toml('subject = "nearest to (20, 17) in 01"\n'),
        "capture.toml: subject: (20.0, 17.0) is outside the pictures of camera 01, 24 x 16 px; correct it",
    ),
    "toml with a subject left of the pictures": (
        _toml('subject = "nearest to (-1, 7) in 01"\n'),
        "capture.toml: subject: (-1.0, 7.0) is outside the pictures of camera 01, 24 x 16 px; correct it",
    ),
    "toml with a subject in an unknown camera": (
        _toml('subject = "nearest to (1, 2) in 07"\n'),
        "no training camera 07",
    ),
    "toml with an impossible field of view": (_toml("field_of_view_deg = 200\n"), "field_of_view_deg"),
    "toml name leaves the store": (_toml('name = "../../other"\n'), "name '../../other'"),
}

POSE2SIM = {
    "no calibration file": (lambda f: (f / TABLES).unlink(), "walker: 2 videos without calibration"),
    "calibration is a pickle": (_written(TABLES, pickle.dumps(Bomb())), "Calib.toml: is not UTF-8 text"),
    "no camera": (_written(TABLES, "[metadata]\nerror = 0.0\n"), "Calib.toml: calibrates no camera"),
    "NaN": (_edited(TABLES, "50.0", "nan"), "Calib.toml: camera cam01: K"),
    "key missing": (_edited(TABLES, "rotation", "rot"), "Calib.toml: camera cam01: 'rotation'"),
    "camera is not a table": (_written(TABLES, "cam01 = 1\n"), "Calib.toml: calibrates no camera"),
    "matrix is not one": (
        _edited(TABLES, "matrix = [[50.0,", "matrix = [["),
        "Calib.toml: camera cam01: its table, or",
    ),
    "two cameras of one name": (
        _edited(TABLES, 'name = "cam02"', 'name = "cam01"'),
        "Calib.toml: two cameras are called cam01",
    ),
    "fisheye of five coefficients": (
        lambda f: [
            _edited(TABLES, "distortions = [0.0,", "distortions = [0.0, 0.0,")(f),
            _edited(TABLES, "fisheye = false", "fisheye = true")(f),
        ],
        "Calib.toml: camera cam01: distortion has 5 numbers, not 4",
    ),
    "fisheye is a text": (
        _edited(TABLES, "fisheye = false", 'fisheye = "false"'),
        "Calib.toml: camera cam01: its table, or",
    ),
    "video missing": (lambda f: (f / "videos/cam02.mp4").unlink(), "images/cam02: no JPEG or PNG"),
    "two videos of one camera": (
        lambda f: shutil.copy(f / "videos/cam02.mp4", f / "videos/cam02.MOV"),
        "videos/cam02.mp4: camera cam02 is also cam02.MOV; keep one of them",
    ),
    "video is not a video": (_written("videos/cam02.mp4", b"0" * 100), "videos/cam02.mp4: not a readable video"),
    "video is a playlist of other files": (
        lambda f: [
            (f / "videos/cam02.mp4").rename(f / "videos/cam02"),
            (f / "videos/cam02.mp4").write_text("ffconcat version 1.0\nfile cam02\nduration 0.4\n"),
        ],
        "videos/cam02.mp4: not a readable video",
    ),
    "video cut short": (lambda f: _cut_video(f / "videos/cam02.mp4"), "cam02.mp4: 10 frames declared"),
    "unequal frame counts": (lambda f: rec.write_video(f / "videos/cam02.mp4", 9), "videos/cam02.mp4: 9 frames"),
    "video of another rate": (
        lambda f: rec.write_video(f / "videos/cam02.mp4", 10, fps=24),
        "videos/cam02.mp4: 24 frames a second, but",
    ),
    "video of another size": (
        lambda f: rec.write_video(f / "videos/cam02.mp4", 10, (48, 64)),
        "videos/cam02.mp4: is 48 x 64",
    ),
    "keypoint file missing": (
        lambda f: (f / "pose/cam01_json/cam01_000003.json").unlink(),
        "pose/cam01_json: 9 keypoints",
    ),
}


def _cut_video(path: Path) -> None:
    """Cut a video short: the header still declares ten frames, but the data of the later ones is gone."""
    data = path.read_bytes()
    start = data.index(b"mdat") + 4
    length = int.from_bytes(data[start - 8 : start - 4], "big") - 8
    path.write_bytes(data[: start + length // 2] + bytes(length - length // 2) + data[start + length :])


@pytest.mark.parametrize(
    ("write", "damage", "names"),
    [
        pytest.param(write, *case, id=name)
        for write, cases in ((rec.write_easymocap, EASYMOCAP), (rec.write_pose2sim, POSE2SIM))
        for name, case in cases.items()
    ],
)
def test_a_damaged_recording_is_refused(
    write: Callable[[Path], Path],
    damage: Damage,
    names: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = write(tmp_path / "walker")
    damage(folder)
    message = rec.refusal(folder, tmp_path / "out")
    assert names in message and len(message) < 400
    assert not (tmp_path / "pickle-was-loaded").exists()


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name, why in (("empty", "none of these: EasyMocap"), ("absent", "no such folder")):
        message = rec.refusal(tmp_path / name, tmp_path / "out")
        assert why in message and len(message) < 400
