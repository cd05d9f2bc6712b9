"""A PeopleSnapshot folder of six frames, with the same files as the published subjects."""

import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.formats import peoplesnapshot
from hnerf.capture.formats.peoplesnapshot import PeopleSnapshot
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture import recordings as rec


def write_hdf5(path: Path, **arrays: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, chunks=True, compression="gzip")


def write_peoplesnapshot(folder: Path, frames: int, size_px: tuple[int, int]) -> Path:
    """Write a recording with one pose more than frames. Row i of the poses holds i, so that frame f has row f + 1; the
    last was never reconstructed."""
    width, height = size_px
    rec.write_video(folder / f"{folder.name}.mp4", frames, size_px)
    camera = {"camera_f": np.array([50.0, 50]), "camera_c": (np.array(size_px) - 1) / 2, "camera_k": np.zeros(5)}
    camera |= {"camera_t": np.zeros(3), "camera_rt": np.zeros(3), "width": width, "height": height}
    (folder / "camera.pkl").write_bytes(pickle.dumps(camera, 2))
    masks = np.zeros((frames, height, width), np.uint8)
    masks[:, 10:20, 20:30] = 1
    write_hdf5(folder / "masks.hdf5", masks=masks)
    keypoints = np.stack([np.arange(18.0), 2 * np.arange(18.0), np.full(18, 0.8)], -1).ravel()
    write_hdf5(folder / "keypoints.hdf5", keypoints=np.tile(keypoints, (frames, 1)))
    pose, trans = np.tile(np.arange(frames + 1.0)[:, None], (1, 72)), np.tile([0.1, 0.2, 2.5], (frames + 1, 1))
    pose[frames], trans[frames] = 0, 0
    write_hdf5(folder / "reconstructed_poses.hdf5", pose=pose, trans=trans, betas=np.arange(10.0))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_peoplesnapshot(tmp_path / "female-1", 6, (64, 48))


@pytest.fixture
def capture(folder: Path, tmp_path: Path) -> Capture:
    return ingest(folder, CaptureSettings(), tmp_path / "out")


def test_the_world_is_turned_upright(capture: Capture) -> None:
    """A point 2.5 m ahead of the camera, 0.1 m to its right and 0.2 m below lies at (0.1, 2.5, -0.2)."""
    camera = capture.cameras["camera"]
    pixel, depth_m = camera.project(np.array([0.1, 2.5, -0.2]))
    assert pixel == pytest.approx([31.5 + 50 * 0.1 / 2.5, 23.5 + 50 * 0.2 / 2.5]) and depth_m == pytest.approx(2.5)
    assert capture.up == "z" and capture.train_frames == (0, 1, 2, 3, 4, 5)


def test_keypoints_are_read_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    whole = peoplesnapshot._array
    monkeypatch.setattr(peoplesnapshot, "_array", lambda *what: read.append(what[1]) or whole(*what))
    frames = PeopleSnapshot(folder).keypoint_files("camera").values()
    assert [frame.read().shape for frame in frames] == [(1, 18, 3)] * 6
    assert read == ["keypoints"]


def test_masks_and_keypoints_are_read(capture: Capture) -> None:
    mask, keypoints = capture.given_mask("camera", 3), capture.keypoints("camera")
    assert mask is not None and mask[10:20, 20:30].all() and mask.sum() == 100
    assert keypoints is not None and keypoints[5, 0, 1].tolist() == [1, 2, 0.8]  # the neck
    assert keypoints[5, 0, 8] == pytest.approx([9.5, 19, 0.8])  # the middle of hips 8 and 11
    assert not keypoints[..., 19:, :].any()


def test_given_poses_are_aligned_from_the_end(capture: Capture) -> None:
    given = capture.given_poses()
    assert given is not None and given.known.tolist() == [True] * 5 + [False]
    assert given.theta[0].ravel().tolist() == [1.0] * 72 and given.theta[4, 0].tolist() == [5.0] * 3
    # SMPL's origin, and its y axis, which points down in the world of that camera
    assert given.root[0] @ [0, 0, 0, 1] == pytest.approx([0.1, 2.5, -0.2, 1])
    assert given.root[0] @ [0, 1, 0, 0] == pytest.approx([0, 0, -1, 0])
    assert given.betas.tolist() == list(range(10))


def test_confidences_beyond_0_to_1_are_clipped(folder: Path) -> None:
    """As in all other layouts."""
    write_hdf5(folder / "keypoints.hdf5", keypoints=np.tile([5.0, 5.0, 1.5, 5.0, 5.0, -0.5], (6, 9)))
    (people,) = PeopleSnapshot(folder).keypoint_files("camera")[0].read()
    assert people[:2, 2].tolist() == [1, 0]


@pytest.mark.parametrize("name", ["masks", "keypoints"])
def test_more_rows_than_frames_are_refused_before_they_are_read(name: str, folder: Path, tmp_path: Path) -> None:
    """A few kilobytes declare four billion rows; a dictionary of them would fill any memory."""
    with h5py.File(folder / f"{name}.hdf5", "r+") as file:
        row = file[name].shape[1:]
        del file[name]
        file.create_dataset(name, shape=(4_000_000_000, *row), dtype=np.uint8, chunks=(1, *row))
    assert f"{name}.hdf5: 4000000000 {name} for 6 frames" in rec.refusal(folder, tmp_path / "out")


def test_any_damaged_byte_is_refused_or_harmless(folder: Path, tmp_path: Path) -> None:
    """On damage, HDF5's own reader raises KeyError, ValueError or OSError."""
    layout, stored = PeopleSnapshot(folder), (folder / "reconstructed_poses.hdf5").read_bytes()
    refused = 0
    for at in range(0, len(stored), 97):
        (folder / "reconstructed_poses.hdf5").write_bytes(stored[:at] + bytes([stored[at] ^ 0xFF]) + stored[at + 1 :])
        try:
            layout.given_poses((0, 1))
        except InputError:
            refused += 1
    assert refused > 0


def test_impossibly_distant_poses_are_refused(folder: Path, tmp_path: Path) -> None:
    with h5py.File(folder / "reconstructed_poses.hdf5", "r+") as file:
        file["trans"][2] = 1e30
    assert "reconstructed_poses.hdf5: translations of a pose are NaN or beyond" in rec.refusal(folder, tmp_path / "out")


def test_damaged_files_are_named(folder: Path, tmp_path: Path) -> None:
    out, poses = tmp_path / "out", folder / "reconstructed_poses.hdf5"
    rec.write_video(folder / "other.mp4", 6)
    assert "female-1: 2 videos .mp4; leave exactly one" in rec.refusal(folder, out)
    (folder / "other.mp4").unlink()
    for moves, betas, what in ((5, 10, "6 poses, 5 translations"), (6, 9, "9 betas are not SMPL's")):
        write_hdf5(poses, pose=np.zeros((6, 72)), trans=np.zeros((moves, 3)), betas=np.zeros(betas))
        assert f"reconstructed_poses.hdf5: {what}" in rec.refusal(folder, out)
    with h5py.File(poses, "r+") as file:
        del file["betas"]
        file["betas"] = h5py.ExternalLink("/etc/hostname", "betas")
    assert "reconstructed_poses.hdf5: has no array of numbers called betas" in rec.refusal(folder, out)
    write_hdf5(folder / "masks.hdf5", masks=np.zeros((5, 48, 64), np.uint8))
    assert "masks.hdf5: 5 masks for 6 frames" in rec.refusal(folder, out)
    write_hdf5(folder / "masks.hdf5", masks=np.zeros((6, 48), np.uint8))
    assert "masks.hdf5: masks are not images (N, H, W)" in rec.refusal(folder, out)
    (folder / "masks.hdf5").write_bytes(b"nothing")
    assert "masks.hdf5: not a readable HDF5 file" in rec.refusal(folder, out)
    write_hdf5(folder / "keypoints.hdf5", keypoints=np.full((6, 54), np.nan))
    assert "keypoints.hdf5: keypoints is not (N, 54) finite numbers" in rec.refusal(folder, out)
    write_hdf5(folder / "keypoints.hdf5", keypoints=np.tile([1e308, 5.0, 0.5], (6, 18)))
    assert "keypoints.hdf5: a keypoint is beyond 1e+06 px" in rec.refusal(folder, out)
    (folder / "camera.pkl").write_bytes(pickle.dumps({"camera_f": [1]}))
    assert "camera.pkl: camera_f, _c, _k, _rt, _t, width or height is missing" in rec.refusal(folder, out)
