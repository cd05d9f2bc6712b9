"""A ZJU-MoCap folder of two cameras and three frames, as NeuralBody prepares it."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hnerf.capture.capture import write_image
from hnerf.capture.ingest import exported_lenses, ingest
from hnerf.config import CaptureSettings
from tests.capture import recordings as rec

CAMERAS = ("Camera_B1", "Camera_B2")


def write_zju(folder: Path, names: tuple[str, ...] = CAMERAS, frame: str = "{:06d}.jpg") -> Path:
    """Write the cameras of recordings.py with translations in mm, and masks whose left half has label 3."""
    rows = [[f"{name}/" + frame.format(f) for name in names] for f in range(3)]
    for row in rows:
        for path in row:
            write_image(folder / path, np.full((rec.HEIGHT, rec.WIDTH, 3), 90, np.uint8))
            labels = np.zeros((rec.HEIGHT, rec.WIDTH, 3), np.uint8)
            labels[:, :12] = 3
            write_image((folder / "mask_cihp" / path).with_suffix(".png"), labels)
    turns = [rec.ROTATIONS[name] for name in rec.CAMERAS] * 12
    cams: dict[str, Any] = {
        "K": [np.array(rec.K)] * len(names),
        "D": [np.zeros((5, 1))] * len(names),
        "R": [np.array(R) for R in turns[: len(names)]],
        "T": [np.array([[0.0], [1000], [3000]])] * len(names),
    }
    annotations: Any = {"cams": cams, "ims": [{"ims": np.array(row)} for row in rows]}
    np.save(folder / "annots.npy", annotations, allow_pickle=True)
    return folder


def write_parameters(path: Path, poses: np.ndarray, **others: Any) -> None:
    """Write a pose with a quarter turn about the vertical, then a move by (1, 2, 3) m."""
    path.parent.mkdir(exist_ok=True)
    parameters: Any = {"poses": poses, "Rh": np.array([[0, 0, np.pi / 2]]), "Th": np.array([[1.0, 2, 3]])}
    np.save(path, parameters | {"shapes": np.arange(10.0)[None]} | others, allow_pickle=True)  # type: ignore[arg-type]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_zju(tmp_path / "zju")


def test_cameras_images_and_masks_are_read(folder: Path, tmp_path: Path) -> None:
    capture = ingest(folder, CaptureSettings(), tmp_path / "out")
    assert capture.train_cameras == CAMERAS and capture.train_frames == (0, 1, 2)
    assert capture.cameras["Camera_B1"].centre_m == pytest.approx([-3, 0, 1], abs=1e-9)
    mask = capture.given_mask("Camera_B2", 2)
    assert mask is not None and mask[:, :12].all() and not mask[:, 12:].any()
    assert capture.image("Camera_B2", 1).shape == (rec.HEIGHT, rec.WIDTH, 3)
    assert capture.keypoints("Camera_B1") is None and capture.given_poses() is None


@pytest.mark.parametrize("units", ['"mm"', "0.001"])
def test_stating_millimetres_once_more_is_refused(units: str, folder: Path, tmp_path: Path) -> None:
    (folder / "capture.toml").write_text(f"units = {units}\n")
    assert rec.refusal(folder, tmp_path / "out") == (
        f"{folder / 'capture.toml'}: units: translations in annots.npy count as millimetres anyway; remove the line"
    )


def test_cameras_may_lack_masks(folder: Path, tmp_path: Path) -> None:
    """Camera_B1 has none; those of Camera_B2 are in mask/, next to an empty mask_cihp/."""
    (folder / "mask_cihp").rename(folder / "mask")
    (folder / "mask_cihp").mkdir()
    shutil.rmtree(folder / "mask" / "Camera_B1")
    capture = ingest(folder, CaptureSettings(), tmp_path / "out")
    assert capture.given_mask("Camera_B1", 0) is None and capture.given_mask("Camera_B2", 0) is not None


def test_given_poses_are_read(folder: Path, tmp_path: Path) -> None:
    """new_params/ overrides params/, so frame 1 has no pose. 69 angles leave out the pelvis."""
    turns = np.arange(72.0) * (np.arange(72) >= 3)
    write_parameters(folder / "new_params" / "0.npy", turns[None])
    write_parameters(folder / "new_params" / "2.npy", turns[3:])
    write_parameters(folder / "params" / "1.npy", turns)
    given = ingest(folder, CaptureSettings(), tmp_path / "out").given_poses()
    assert given is not None and given.known.tolist() == [True, False, True]
    for row in (0, 2):
        assert given.theta[row].ravel().tolist() == turns.tolist()
        assert given.root[row] == pytest.approx(np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]]))
    assert given.betas.tolist() == list(range(10))


def test_training_cameras_are_those_of_published_work(tmp_path: Path) -> None:
    names = tuple(f"Camera ({k})" for k in range(1, 22))
    frame = "CoreView_313_Camera_(1)_{:04d}_2019-08-23_16-08-50.592.jpg"
    capture = ingest(write_zju(tmp_path / "zju", names, frame), CaptureSettings(), tmp_path / "out")
    assert capture.train_cameras == ("Camera (1)", "Camera (7)", "Camera (13)", "Camera (19)")
    assert len(capture.test_cameras) == 17 and capture.train_frames == (0, 1, 2)
    assert all(capture.given_mask(name, 2) is not None for name in capture.test_cameras)  # masks are for scoring


def test_damaged_files_are_named(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (folder / "params").mkdir()
    np.save(folder / "params" / "1.npy", {"poses": np.zeros(72)}, allow_pickle=True)  # type: ignore[arg-type]
    assert "1.npy: no poses, Rh, Th and shapes of SMPL" in rec.refusal(folder, out)
    write_parameters(folder / "params" / "1.npy", np.zeros(10))
    assert "1.npy: 10 turns and 10 shape values are not SMPL's" in rec.refusal(folder, out)
    for name, value, what in (
        ("shapes", np.full((1, 10), np.nan), "shape values"),
        ("Th", [[1e30, 0, 0]], "translations"),
        ("Rh", [[np.inf, 0, 0]], "turns"),
    ):
        write_parameters(folder / "params" / "1.npy", np.zeros(72), **{name: value})
        assert f"1.npy: {what} of a pose are NaN or beyond" in rec.refusal(folder, out)
    (folder / "params" / "1.npy").rename(folder / "params" / "9.npy")
    assert "none of the chosen frames has a given pose" in rec.refusal(folder, out)
    (folder / "mask_cihp" / "Camera_B2" / "000001.png").unlink()
    assert "mask_cihp/Camera_B2/000001.png: image missing; add it" in rec.refusal(folder, out)
    annotations = np.load(folder / "annots.npy", allow_pickle=True).item()
    for frame, row in enumerate(annotations["ims"]):
        row["ims"] = [row["ims"][0], f"../secret/{frame:06d}.jpg"]
    np.save(folder / "annots.npy", annotations, allow_pickle=True)
    assert "leaves the capture folder" in rec.refusal(folder, out)
    del annotations["cams"]["T"]
    np.save(folder / "annots.npy", annotations, allow_pickle=True)
    assert "annots.npy: camera Camera_B1: K, D, R or T is missing" in rec.refusal(folder, out)
    np.save(folder / "annots.npy", {"cams": {}, "ims": []}, allow_pickle=True)  # type: ignore[arg-type]
    assert "annots.npy: 'ims' does not list images" in rec.refusal(folder, out)


@pytest.mark.parametrize("stray", ["Camera_B1/000001.jpg", "Camera_B2/000002.jpg"])
def test_images_of_another_camera_or_frame_are_refused(stray: str, folder: Path, tmp_path: Path) -> None:
    """Any row but the first could exchange cameras, and any column but the first could exchange frames."""
    annotations = np.load(folder / "annots.npy", allow_pickle=True).item()
    annotations["ims"][1]["ims"][1] = stray
    np.save(folder / "annots.npy", annotations, allow_pickle=True)
    message = rec.refusal(folder, tmp_path / "out")
    assert f"annots.npy: lists '{stray}' where another camera or frame belongs" in message


@pytest.mark.parametrize("name", ["1566547850592{}.jpg", "a_b_c_d_-{}_x.jpg", "²{}.jpg"])
def test_frames_that_are_no_numbers_of_up_to_nine_digits_are_refused(name: str, tmp_path: Path) -> None:
    message = rec.refusal(write_zju(tmp_path / "zju", frame=name), tmp_path / "out")
    assert "annots.npy: 'ims' does not list images by frame number" in message


def test_exported_cameras_have_the_size_of_their_images(folder: Path) -> None:
    """annots.npy states no size; translations are already in metres."""
    lenses = exported_lenses(folder)
    assert [(lens.size_px, lens.t_m.tolist()) for lens in lenses] == [((rec.WIDTH, rec.HEIGHT), [0, 1, 3])] * 2
    for path in folder.rglob("*.jpg"):
        path.unlink()
    assert {lens.size_px for lens in exported_lenses(folder)} == {None}
