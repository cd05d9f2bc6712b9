"""Camera files of other tools, read, written, and read back; numbers worked out by hand."""

import dataclasses
import struct
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from flows.cli import main
from hnerf.capture.formats.caliscope import Caliscope
from hnerf.capture.formats.colmap import Colmap, write_colmap
from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.formats.export import write_calibration, write_cameras
from hnerf.capture.formats.layout import Layout
from hnerf.capture.formats.pose2sim import Pose2Sim
from hnerf.capture.ingest import ingest, recognise
from hnerf.capture.lens import Lens, distort_points
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture import recordings as rec
from tests.full_disk import files_up_to

CAMERAS_TXT = "# Camera list\n1 SIMPLE_RADIAL 640 480 500 320 240 0.1\n2 PINHOLE 24 16 20 21 12 8\n"
# A quarter turn about x, quaternion w x y z = (cos 45, sin 45, 0, 0): y goes to z, z to -y.
IMAGES_TXT = (
    "# Image list\n7 0.7071067811865476 0.7071067811865476 0 0 1 2 3 1 01/000000.jpg\n10.5 20.5 -1 30.5 40.5 -1\n"
    "9 1 0 0 0 0 0 4 2 02.png\n\n"
)
LENSES = [
    Lens("cam_0", np.array([[500.0, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]), np.array([0.1, -0.2, 0.01, 0.02, 0.3]),
         np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([1.0, 2, 3]), (640, 480)),
    Lens("cam_3", np.array([[20.0, 0, 11.5], [0, 20, 7.5], [0, 0, 1]]), np.array([0.1, -0.2, 0.01, 0.02]),
         cv2.Rodrigues(np.array([0.1, 0.2, 0.3]))[0], np.array([0.0, 0, 4]), (24, 16)),
    Lens("cam_4", np.array([[20.0, 0, 11.5], [0, 20, 7.5], [0, 0, 1]]), np.zeros(4), np.eye(3), np.zeros(3), (24, 16)),
    Lens("cam_5", np.array([[20.0, 0, 11.5], [0, 20, 7.5], [0, 0, 1]]), np.array([0.5, 0, 0, 0.01, 0, 0.25, 0, 0.1]),
         np.eye(3), np.zeros(3), (24, 16)),
]  # fmt: skip
FISHEYE = dataclasses.replace(LENSES[1], name="cam_6", distortion=np.array([0.1, -0.05, 0.02, -0.01]), fisheye=True)


def write_model(folder: Path, binary: bool = False) -> Path:
    """Write the model above in sparse/0."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(CAMERAS_TXT)
    (model / "images.txt").write_text(IMAGES_TXT)
    if binary:
        (model / "points3D.txt").write_text("")
        to_binary(model)
    return folder


def to_binary(model: Path) -> None:
    """Replace the text files of a model by binary ones."""
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()


def test_the_documented_example_is_a_camera_where_it_says(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "formats.md").read_text()
    example = page.partition("## Your own calibration")[2].partition("```toml\n")[2].partition("```")[0]
    (tmp_path / "calibration.toml").write_text(example)
    lens = Caliscope(tmp_path).lenses()["front"]
    assert (-lens.R.T @ lens.t_m).tolist() == pytest.approx([0, -4, 1.5], abs=1e-6)
    assert lens.R[2].tolist() == pytest.approx([0, 1, 0], abs=1e-6)  # looks along +Y
    assert lens.R[1].tolist() == pytest.approx([0, 0, -1], abs=1e-6)  # stands upright


@pytest.mark.parametrize("binary", [False, True])
def test_a_colmap_model_is_read(binary: bool, tmp_path: Path) -> None:
    lenses = Colmap(write_model(tmp_path, binary)).lenses()
    assert set(lenses) == {"01", "02"}
    first = lenses["01"]
    assert first.K.tolist() == [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]  # half a pixel less
    assert first.distortion.tolist() == [0.1, 0, 0, 0, 0] and first.size_px == (640, 480)
    assert np.allclose(first.R, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]) and first.t_m.tolist() == [1, 2, 3]
    assert lenses["02"].K.tolist() == [[20, 0, 11.5], [0, 21, 7.5], [0, 0, 1]]


@pytest.mark.parametrize(
    ("name", "at", "value", "message"),
    [
        ("cameras.bin", 0, struct.pack("<Q", 1 << 60), "not a COLMAP model"),  # number of cameras
        ("images.bin", 0, struct.pack("<Q", 1 << 60), "not a COLMAP model"),  # number of images
        ("cameras.bin", 12, struct.pack("<i", 7), "other cameras than SIMPLE_PINHOLE"),  # FOV
        ("cameras.bin", 16, struct.pack("<Q", 1 << 40), "declares 1.09951e.12 x 480 px"),  # width
        ("images.bin", 86, struct.pack("<Q", 1 << 60), "not a COLMAP model"),  # number of points, after the name
        ("images.bin", 12, struct.pack("<d", float("nan")), "its quaternion is not of length 1"),
        ("images.bin", 72, b"../../etc/pwd", r"camera name '\.\.'"),
    ],
)
def test_hostile_colmap_models_are_refused(name: str, at: int, value: bytes, message: str, tmp_path: Path) -> None:
    path = write_model(tmp_path, binary=True) / "sparse" / "0" / name
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)
    with pytest.raises(InputError, match=f"{name}: .*{message}"):
        Colmap(tmp_path).lenses()


def test_a_colmap_line_cut_short_is_refused(tmp_path: Path) -> None:
    """One to nine of the ten fields of a line of images.txt are left."""
    path = write_model(tmp_path) / "sparse" / "0" / "images.txt"
    line = next(line for line in IMAGES_TXT.splitlines() if line.endswith("01/000000.jpg"))
    for parts in range(1, 10):
        path.write_text(" ".join(line.split()[:parts]))
        with pytest.raises(InputError, match=r"images\.txt: not a COLMAP model"):
            Colmap(tmp_path).lenses()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("02.png", "01/000001.jpg", "several images of camera 01"),
        ("4 2 02.png", "4 5 02.png", "camera 5 is not in"),
        ("9 1 0 0 0", "9 0 0 0 0", "its quaternion is not of length 1"),
        ("7 0.7", "7 zero", "not a COLMAP model"),
    ],
)
def test_inconsistent_colmap_models_are_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = write_model(tmp_path) / "sparse" / "0" / "images.txt"
    assert old in IMAGES_TXT
    path.write_text(IMAGES_TXT.replace(old, new))
    with pytest.raises(InputError, match=message):
        Colmap(tmp_path).lenses()


def test_a_rational_colmap_lens_is_read(tmp_path: Path) -> None:
    simple, full = "SIMPLE_RADIAL 640 480 500 320 240 0.1", "FULL_OPENCV 640 480 500 500 320 240 1 2 3 4 5 6 7 8"
    (write_model(tmp_path) / "sparse" / "0" / "cameras.txt").write_text(CAMERAS_TXT.replace(simple, full))
    assert Colmap(tmp_path).lenses()["01"].distortion.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("model", ["SIMPLE_RADIAL_FISHEYE 500", "RADIAL_FISHEYE 500", "OPENCV_FISHEYE 500 510"])
def test_a_colmap_fisheye_images_points_as_colmap_does(model: str, binary: bool, tmp_path: Path) -> None:
    """At the first camera's place, (0.8, -0.6, 1) from it: 45 degrees off the axis."""
    (name, *focal), k = model.split(), {"S": "-0.1", "R": "-0.1 0.03", "O": "-0.1 0.03 0.02 0.01"}[model[0]]
    cameras = CAMERAS_TXT.replace(
        "SIMPLE_RADIAL 640 480 500 320 240 0.1", f"{name} 640 480 {' '.join(focal)} 320 240 {k}"
    )
    folder = write_model(tmp_path)
    (folder / "sparse" / "0" / "cameras.txt").write_text(cameras)
    (folder / "sparse" / "0" / "points3D.txt").write_text("")
    colmap = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    if binary:
        to_binary(folder / "sparse" / "0")
    lens = Colmap(folder).lenses()["01"]
    ray = np.array([0.8, -0.6, 1.0])
    seen = colmap.image(7).project_point(lens.R.T @ (ray - lens.t_m)) - 0.5
    assert lens.fisheye and distort_points((lens.K @ ray)[None, :2], lens)[0] == pytest.approx(seen, abs=1e-9)


@pytest.mark.parametrize(
    ("layout", "reader"),
    [("colmap", Colmap), ("caliscope", Caliscope), ("aniposelib", Caliscope), ("easymocap", EasyMocap)],
)
def test_written_cameras_are_read_back(layout: str, reader: type[Layout], tmp_path: Path) -> None:
    lenses = LENSES if layout == "easymocap" else [*LENSES, FISHEYE]
    write_cameras(tmp_path, lenses, layout)
    assert type(recognise(tmp_path)) is reader
    read = recognise(tmp_path).lenses()
    assert list(read) == [lens.name for lens in lenses]
    for lens in lenses:
        found = read[lens.name]
        assert found.fisheye == lens.fisheye
        assert np.allclose(found.K, lens.K, atol=1e-12) and found.size_px == lens.size_px
        assert np.allclose(found.R, lens.R, atol=1e-12) and np.allclose(found.t_m, lens.t_m, atol=1e-12)
        padded = [np.pad(d, (0, 8 - len(d))) for d in (found.distortion, lens.distortion)]
        assert np.allclose(*padded, atol=1e-12)


@pytest.mark.parametrize(("layout", "reader"), [("colmap", Colmap), ("caliscope", Caliscope)])
def test_intrinsics_next_to_another_calibration_do_not_take_precedence(
    layout: str, reader: type[Layout], tmp_path: Path
) -> None:
    """`intri.yml` is a calibration only together with `extri.yml`."""
    write_cameras(tmp_path, LENSES, "easymocap")
    write_cameras(tmp_path, LENSES, layout)
    assert type(recognise(tmp_path)) is EasyMocap
    (tmp_path / "extri.yml").unlink()
    assert type(recognise(tmp_path)) is reader


@pytest.mark.parametrize("layout", ["colmap", "caliscope", "aniposelib"])
def test_formats_that_require_an_image_size_are_not_written_without_one(layout: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="camera cam_3 has no size; add W_cam_3 and H_cam_3"):
        write_cameras(tmp_path, [LENSES[0], dataclasses.replace(LENSES[1], size_px=None)], layout)
    assert list(tmp_path.iterdir()) == []


def test_caliscope_numbers_have_no_leading_zeros(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The file has no room for names: the log says which camera a number is."""
    names = ("cam_01", "cam_08", "cam_10")
    write_cameras(tmp_path, [dataclasses.replace(a, name=b) for a, b in zip(LENSES, names, strict=False)], "caliscope")
    assert list(recognise(tmp_path).lenses()) == ["cam_0", "cam_1", "cam_2"]
    assert caplog.messages == ["Caliscope numbers cameras: cam_01 is cam_0, cam_08 is cam_1, cam_10 is cam_2"]


@pytest.mark.parametrize("layout", ["easymocap", "caliscope", "aniposelib"])
def test_a_lens_that_was_estimated_is_still_marked_when_it_is_read_back(layout: str, tmp_path: Path) -> None:
    """Else a calibration from a board would take a guess for given."""
    write_cameras(tmp_path, [LENSES[0], dataclasses.replace(LENSES[1], estimated=True)], layout)
    assert [lens.estimated for lens in recognise(tmp_path).lenses().values()] == [False, True]


def test_a_fisheye_cannot_be_written_for_easymocap(tmp_path: Path) -> None:
    """A new calibration with one is written in TOML, which is then the folder's calibration."""
    with pytest.raises(
        InputError, match=r"^camera cam_6: is a fisheye, which intri\.yml cannot express; export another"
    ):
        write_cameras(tmp_path, [*LENSES, FISHEYE], "easymocap")
    assert list(tmp_path.iterdir()) == []
    write_calibration(tmp_path, [LENSES[0], FISHEYE], "person", (), False)
    assert [path.name for path in tmp_path.iterdir()] == ["calibration.toml"]
    assert [lens.fisheye for lens in recognise(tmp_path).lenses().values()] == [False, True]


def test_skew_cannot_be_written_for_colmap(tmp_path: Path) -> None:
    K = np.array([[1000.0, 40, 500], [0, 1000, 500], [0, 0, 1]])  # 40 px at one focal length off the axis
    with pytest.raises(InputError, match="camera 01: has skew"):
        write_colmap(tmp_path, [Lens("01", K, np.zeros(4), np.eye(3), np.zeros(3), (1000, 1000))])


def test_a_colmap_model_cut_short_by_a_full_disk_is_an_error(tmp_path: Path) -> None:
    with files_up_to(250), pytest.raises(OSError, match="sparse/0: cannot be written; is the disk full"):
        write_colmap(tmp_path, LENSES)


def test_colmap_projects_to_the_same_pixels(tmp_path: Path) -> None:
    """A point that projects to pixel (319.5, 239.5) here projects to (320, 240) there."""
    lenses = [*LENSES, FISHEYE, dataclasses.replace(FISHEYE, name="cam_7", distortion=np.zeros(4))]
    write_cameras(tmp_path, lenses, "colmap")
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    names = [model.cameras[i].model.name for i in range(1, 7)]
    assert names == ["FULL_OPENCV", "OPENCV", "PINHOLE", "FULL_OPENCV", "OPENCV_FISHEYE", "OPENCV_FISHEYE"]
    on_axis = LENSES[0].R.T @ (np.array([0, 0, 2.0]) - LENSES[0].t_m)
    assert model.image(1).project_point(on_axis).tolist() == pytest.approx([320, 240])
    beside = np.array([0.3, 0.2, 2.0])
    for number, lens in enumerate(lenses, start=1):
        uv = distort_points((lens.K @ beside)[None, :2] / beside[2], lens)[0]
        assert model.image(number).project_point(lens.R.T @ (beside - lens.t_m)) == pytest.approx(uv + 0.5)


def test_opencv_and_pose2sim_read_what_is_written(tmp_path: Path) -> None:
    write_cameras(tmp_path, LENSES, "easymocap")
    extri = cv2.FileStorage(str(tmp_path / "extri.yml"), cv2.FILE_STORAGE_READ)
    assert np.allclose(extri.getNode("Rot_cam_3").mat(), LENSES[1].R)
    write_cameras(tmp_path / "calibration", LENSES, "aniposelib")
    (tmp_path / "calibration" / "calibration.toml").rename(tmp_path / "calibration" / "Calib.toml")
    assert np.allclose(Pose2Sim(tmp_path).lenses()["cam_3"].R, LENSES[1].R)


def test_caliscope_cameras_marked_as_ignored_are_left_out(tmp_path: Path) -> None:
    write_cameras(tmp_path, LENSES, "caliscope")
    text = (tmp_path / "camera_array.toml").read_text().replace("ignore = false", "ignore = true", 1)
    (tmp_path / "camera_array.toml").write_text(text)
    assert list(recognise(tmp_path).lenses()) == ["cam_3", "cam_4", "cam_5"]
    for name in ("../3", "cam 3 "):  # OpenCV, which stores the cameras in use, drops a space at the end
        (tmp_path / "camera_array.toml").write_text(text.replace("cam_id = 3", f'cam_id = "{name}"'))
        with pytest.raises(InputError, match="camera name"):
            recognise(tmp_path).lenses()
    (tmp_path / "camera_array.toml").write_text("cameras = [1]\n")
    with pytest.raises(InputError, match="no tables"):
        recognise(tmp_path).lenses()


def test_caliscope_cameras_without_a_pose_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Unless only half of the pose is missing."""
    write_cameras(tmp_path, LENSES, "caliscope")
    text = (tmp_path / "camera_array.toml").read_text()
    without_rotation = text.replace("rotation = ", "# ", 1)
    (tmp_path / "camera_array.toml").write_text(without_rotation)
    with pytest.raises(InputError, match="camera 0: 'rotation' is missing"):
        recognise(tmp_path).lenses()
    (tmp_path / "camera_array.toml").write_text(without_rotation.replace("translation = ", "# ", 1))
    assert not caplog.messages and list(recognise(tmp_path).lenses()) == ["cam_3", "cam_4", "cam_5"]
    file = tmp_path / "camera_array.toml"
    assert caplog.messages == [f"{file}: left out, since they have no rotation and translation: 'cam_0'"]


def test_a_colmap_capture_is_ingested_with_its_scale(tmp_path: Path) -> None:
    """A unit of the model is half a metre."""
    folder = rec.write_easymocap(tmp_path / "ada")
    for name in ("intri.yml", "extri.yml"):
        (folder / name).unlink()
    lenses = [Lens(n, np.array(rec.K), np.zeros(4), np.array(rec.ROTATIONS[n]), np.array(rec.TRANSLATIONS_M[n]) * 2,
                   (rec.WIDTH, rec.HEIGHT)) for n in rec.CAMERAS]  # fmt: skip
    write_cameras(folder, lenses, "colmap")
    (folder / "capture.toml").write_text("units = 0.5\n")
    capture = ingest(folder, CaptureSettings(), tmp_path / "out")
    assert capture.cameras["02"].t_m.tolist() == pytest.approx(rec.TRANSLATIONS_M["02"])
    assert np.allclose(capture.cameras["02"].K, rec.K) and len(capture.frames) == len(rec.FRAMES)


def test_the_command_line_exports_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_model(tmp_path / "model")
    (folder / "capture.toml").write_text('units = "mm"\n')
    assert main(["export-cameras", str(folder), "--format", "aniposelib", "--out", str(tmp_path / "out")]) == 0
    assert Caliscope(tmp_path / "out").lenses()["01"].t_m.tolist() == pytest.approx([0.001, 0.002, 0.003])
    assert main(["calibrate", str(folder), "--out", str(tmp_path / "none")]) == 2
    stderr = capsys.readouterr().err
    assert "no board footage" in stderr and "--from person" in stderr and not (tmp_path / "none").exists()
