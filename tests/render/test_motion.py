import dataclasses
import math
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import joint_transforms
from hnerf.errors import InputError
from hnerf.progress import Progress, listening
from hnerf.render.motion import (
    HIPS,
    LEG,
    Motion,
    _read_amass,
    interpolate_poses,
    lowest_points_m,
    read_motion,
    retarget,
    select_frames,
    select_poses,
)
from tests.asset.figure import FRAMES, bending_body, capture, column_rig


def giant() -> BodyFit:
    """Return a body twice as large, with its joints in another order, that stands bent at x = 10 and then jumps 30 cm
    high at x = 11."""
    rig = column_rig()
    rig = dataclasses.replace(rig, vertices_m=2 * rig.vertices_m, joints_m=2 * rig.joints_m)
    extra = torch.tensor([[0.0, 0, 3]])
    names, parents = ("root", "hat", "upper.L"), torch.tensor([-1, 0, 0])
    joints_m = torch.cat([rig.joints_m[:1], extra, rig.joints_m[1:]])
    skin_joints = torch.where(rig.skin_joints == 1, 2, rig.skin_joints)
    free = torch.tensor([False, True, True])
    rig = dataclasses.replace(
        rig, joint_names=names, parents=parents, joints_m=joints_m, skin_joints=skin_joints, free=free
    )
    theta = torch.zeros(2, 3, 3)
    theta[:, 1, 2], theta[:, 2, 0] = 9.0, torch.tensor([0.1, 0.2])
    root = torch.eye(4).repeat(2, 1, 1)
    root[:, :3, 3] = torch.tensor([[10.0, 0, 5], [11, 0, 5.3]])
    return BodyFit(rig, (4, 5), theta, root)


def in_y_up(body: BodyFit) -> BodyFit:
    turn = torch.eye(4)
    turn[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z to y
    return dataclasses.replace(body, root=turn @ body.root)


@pytest.mark.parametrize("up", ["z", "y"])
def test_a_retargeted_motion_is_placed_where_the_body_stood(up: str) -> None:
    own = bending_body()  # its lowest point is at 0.5 m, its root joint at x = 0.5 in the mean, and y = 2
    motion = Motion(giant() if up == "z" else in_y_up(giant()), 10.0, up)
    found = retarget(own, motion, "z")
    torch.testing.assert_close(found.theta[:, 1], torch.tensor([[0.1, 0, 0], [0.2, 0, 0]]))
    assert found.theta[:, 0].count_nonzero() == 0
    torch.testing.assert_close(lowest_points_m(found, "z"), torch.tensor([0.485, 0.785]))  # floor: 5 % of 30 cm up
    torch.testing.assert_close(found.root[:, :2, 3], torch.tensor([[0.0, 2], [1, 2]]))
    torch.testing.assert_close(found.root[:, :3, :3], torch.eye(3).repeat(2, 1, 1))
    assert found.rig is own.rig


def test_locked_joints_that_the_motion_poses_follow_it_as_fingers_do() -> None:
    own = giant()
    own.rig.free[1] = False  # the hat's, which turns by 9
    expected = torch.tensor([[[0.0, 0, 0], [0, 0, 9], [0.1, 0, 0]], [[0, 0, 0], [0, 0, 9], [0.2, 0, 0]]])
    torch.testing.assert_close(retarget(own, Motion(giant(), 10.0, "z"), "z").theta, expected)


@pytest.mark.parametrize("up", ["z", "y"])
def test_hips_stay_in_place_while_the_trunk_pitches(up: str) -> None:
    """The hip is 1.6 m above the origin of the other body's frame, and 0.8 m above the origin in `own`. As the other
    lies down, a quarter turn about x takes the hip from (0, 0, 1.6) to (0, -1.6, 0); the frame moves by (0, 1.6, 1.6),
    so that the hip stays."""
    own, other = (
        dataclasses.replace(body, rig=dataclasses.replace(body.rig, joint_names=(*body.rig.joint_names[:-1], HIPS[0])))
        for body in (bending_body(), giant())
    )
    other.root[1, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    other.root[:, :3, 3] = torch.tensor([[10.0, 0, 5], [10, 1.6, 6.6]])
    found = retarget(own, Motion(other if up == "z" else in_y_up(other), 10.0, up), "z")
    hip_m = joint_transforms(found.rig, found.theta, found.root)[:, 1, :3, 3]
    torch.testing.assert_close(hip_m[:, :2], torch.tensor([[0.5, 2], [0.5, 2]]))


def test_the_path_of_the_hips_is_scaled_by_the_legs() -> None:
    """The other body's legs are twice as long, and it moves by 1 m along x."""
    own, other = (
        dataclasses.replace(
            body, rig=dataclasses.replace(body.rig, joint_names=(LEG[0], *body.rig.joint_names[1:-1], LEG[1]))
        )
        for body in (bending_body(), giant())
    )
    found = retarget(own, Motion(other, 10.0, "z"), "z")
    torch.testing.assert_close(found.root[:, :2, 3], torch.tensor([[0.25, 2], [0.75, 2]]))


@pytest.mark.parametrize("up", ["z", "y"])
def test_retargeting_a_motion_to_its_own_body_changes_only_the_axes(up: str) -> None:
    """Its lowest points are all at 0.5 m, so floor and median coincide."""
    own = bending_body()
    own.rig.joints_m[0, 2] = 0.3
    there = own if up == "z" else in_y_up(own)
    torch.testing.assert_close(retarget(there, Motion(own, 10.0, "z"), up).root, there.root)


def test_single_frames_off_the_floor_do_not_move_a_motion() -> None:
    """One of four frames of the body has its foot 20 cm below the floor and one 60 cm above; one of 21 frames of the
    motion, 10 cm below."""
    own, other = bending_body(), giant()
    own.root[1:3, 2, 3] += torch.tensor([0.6, -0.2])
    root = other.root[:1].repeat(21, 1, 1)
    root[7, 2, 3] -= 0.1
    other = BodyFit(other.rig, tuple(range(21)), other.theta[:1].repeat(21, 1, 1), root)
    expected = torch.full((21,), 0.5)
    expected[7] = 0.4
    torch.testing.assert_close(lowest_points_m(retarget(own, Motion(other, 10.0, "z"), "z"), "z"), expected)


def test_progress_through_the_poses_of_a_motion_is_reported() -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        lowest_points_m(bending_body(), "z")
    count = len(FRAMES)
    assert heard == [("lowest points", done, count) for done in range(count + 1)]


def test_a_motion_that_lacks_a_free_joint_is_refused() -> None:
    other = bending_body()
    other = dataclasses.replace(other, rig=dataclasses.replace(other.rig, joint_names=("root", "tail")))
    with pytest.raises(InputError, match=r"no joint upper\.L"):
        retarget(bending_body(), Motion(other, 10.0, "z"), "z")


def test_half_way_between_two_poses_is_half_the_turn() -> None:
    body = bending_body()
    body.theta[0, 1], body.theta[1, 1] = torch.tensor([0.0, 0, 0]), torch.tensor([math.pi / 2, 0, 0])
    body.root[:2, :3, 3] = torch.tensor([[0.0, 0, 0], [2, 4, 6]])
    body.root[0, :3, :3] = torch.eye(3)
    body.root[1, :3, :3] = torch.from_numpy(Rotation.from_euler("z", 90, degrees=True).as_matrix())
    found = interpolate_poses(body, 3, 4, 3)
    assert found.frames == (0, 1, 2)
    expected = torch.tensor([[0.0, 0, 0], [math.pi / 4, 0, 0], [math.pi / 2, 0, 0]])
    torch.testing.assert_close(found.theta[:, 1], expected)
    torch.testing.assert_close(found.root[1, :3, 3], torch.tensor([1.0, 2, 3]))
    half = math.sqrt(0.5)
    torch.testing.assert_close(found.root[1, :3, :3], torch.tensor([[half, -half, 0], [half, half, 0], [0, 0, 1]]))
    torch.testing.assert_close(found.root[[0, 2]], body.root[:2])


def test_interpolation_between_two_poses_takes_the_shortest_turn() -> None:
    body = bending_body()
    body.theta[0, 1], body.theta[1, 1] = torch.tensor([0.0, 0, 3.0]), torch.tensor([0.0, 0, -3.0])
    middle = interpolate_poses(body, 3, 4, 3).theta[1, 1]
    assert middle.norm() == pytest.approx(math.pi, abs=1e-5)  # over half a turn, not back through zero


@pytest.mark.parametrize(
    ("wanted", "chosen"),
    [(":", (3, 4, 5, 8)), ("4", (4,)), ("4:8", (4, 5)), ("::2", (4, 8)), ("3:9:5", (3, 8)), ("5:", (5, 8))],
)
def test_frames_are_chosen_by_number(wanted: str, chosen: tuple[int, ...]) -> None:
    assert select_frames((3, 4, 5, 8), wanted, Path("ada")) == chosen


@pytest.mark.parametrize(("wanted", "message"), [("6", "ada: no frames 6; it has 3 to 8"), ("a:b", "FIRST:END:STEP")])
def test_missing_frames_are_refused(wanted: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        select_frames((3, 4, 5, 8), wanted, Path("ada"))


def test_poses_of_a_long_motion_are_selected_in_one_pass() -> None:
    """Searching all frames for each would compare 200 * 199 / 2 pairs; a dictionary compares no identical frames."""
    compared = []

    class Frame(int):
        def __eq__(self, other: object) -> bool:
            compared.append(other)
            return super().__eq__(other)

        __hash__ = int.__hash__

    count = 200
    frames = tuple(map(Frame, range(count)))
    body = BodyFit(column_rig(), frames, torch.arange(count).view(-1, 1, 1).float(), torch.zeros(count, 4, 4))
    chosen = select_poses(body, frames[::-1])
    assert len(compared) < count
    assert chosen.theta[:2].flatten().tolist() == [count - 1, count - 2]


def test_the_fit_of_another_subject_is_read_with_its_rate(tmp_path: Path) -> None:
    for name in ("capture", "fit"):
        (tmp_path / name).mkdir()
    dataclasses.replace(capture(), root=tmp_path / "capture").save()
    bending_body().save(tmp_path / "fit")
    motion = read_motion(tmp_path, "4:6")
    assert (motion.fps, motion.up, motion.body.frames) == (10.0, "z", (4, 5))
    torch.testing.assert_close(motion.body.root, bending_body().root[1:3])


def test_amass_poses_turn_the_equivalents_of_smpls_joints(tmp_path: Path) -> None:
    poses, trans = np.zeros((3, 156)), np.array([[0, 0, 9.0], [0.5, 1, 1.2], [0.5, 1, 1.2]])
    poses[:, 0] = np.pi / 2  # SMPL's Y up to AMASS's Z up
    poses[2, 3 * 16 + 2] = -np.pi / 2  # the left arm from level to straight down
    np.savez(tmp_path / "walk.npz", poses=poses, trans=trans, mocap_framerate=120.0, gender="neutral")
    motion = read_motion(tmp_path / "walk.npz", "1:")
    assert (motion.fps, motion.up, motion.body.frames) == (120.0, "z", (1, 2))
    rig = motion.body.rig
    joints_m = joint_transforms(rig, motion.body.theta, motion.body.root)[..., :3, 3]
    at = {
        name: joints_m[:, rig.joint_names.index(name)] for name in ("upperarm01.L", "wrist.L", "head", "upperleg01.L")
    }
    arm = torch.nn.functional.normalize(at["wrist.L"] - at["upperarm01.L"], dim=-1)
    torch.testing.assert_close(arm, torch.tensor([[1.0, 0, 0], [0, 0, -1]]), atol=0.15, rtol=0)  # 9 degrees
    assert (at["head"][:, 2] > at["upperleg01.L"][:, 2] + 0.5).all()
    # The mean SMPL body turns about its pelvis at (0, -0.23, 0.03), and is then moved; its hips are 9 cm below.
    hip = torch.tensor([1 - 0.23, 1.2 + 0.03 - 0.09])
    torch.testing.assert_close(at["upperleg01.L"][0, 1:], hip, atol=0.03, rtol=0)


@pytest.mark.parametrize(
    ("rate", "fps"), [({"mocap_framerate": 120.0}, 120.0), ({"mocap_frame_rate": 60.0}, 60.0), ({}, 30.0)]
)
def test_the_rate_of_amass_has_two_names_and_a_default(rate: dict[str, float], fps: float, tmp_path: Path) -> None:
    np.savez(tmp_path / "walk.npz", poses=np.zeros((1, 165)), trans=np.zeros((1, 3)), **rate)  # type: ignore[arg-type]
    assert _read_amass(tmp_path / "walk.npz")[1] == fps


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"poses": np.zeros((2, 100)), "trans": np.zeros((2, 3))}, "not AMASS's"),
        ({"poses": np.zeros((2, 156)), "trans": np.zeros((3, 3))}, "not AMASS's"),
        ({"poses": np.full((2, 156), np.nan), "trans": np.zeros((2, 3))}, "turns of a pose are NaN or beyond"),
        ({"poses": np.zeros((2, 156)), "trans": np.full((2, 3), 1e30)}, "translations of a pose are NaN or beyond"),
        ({"poses": np.array([None]), "trans": np.zeros((2, 3))}, "plain arrays"),
        ({"poses": np.zeros((2, 72)), "trans": np.zeros((2, 3)), "mocap_framerate": np.array(0)}, "frames per second"),
        ({"poses": np.zeros((2, 72)), "trans": np.zeros((2, 3)), "mocap_framerate": np.ones(2)}, "frames per second"),
    ],
)
def test_invalid_motion_arrays_are_refused(arrays: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "walk.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=f"walk.npz: .*{message}"):
        read_motion(tmp_path / "walk.npz")


def in_headers(archive: bytes, at: int, value: int) -> bytes:
    """Return an archive with another byte in its first local file header and, two bytes further on, in the central
    directory."""
    changed = bytearray(archive)
    for signature, place in ((b"PK\x03\x04", at), (b"PK\x01\x02", at + 2)):
        changed[changed.index(signature) + place] = value
    return bytes(changed)


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole[: len(whole) // 2],
        lambda whole: in_headers(whole, 6, 1),
        lambda whole: in_headers(whole, 8, 99),
    ],
    ids=["truncated", "encrypted", "otherwise compressed"],
)
def test_an_archive_that_cannot_be_unpacked_is_refused(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    np.savez(tmp_path / "walk.npz", poses=np.zeros((2, 156)), trans=np.zeros((2, 3)))
    (tmp_path / "walk.npz").write_bytes(damage((tmp_path / "walk.npz").read_bytes()))
    with pytest.raises(InputError, match=r"walk\.npz: not an \.npz of plain arrays"):
        read_motion(tmp_path / "walk.npz")


def write_poses(path: Path, frames: int, content: bytes = b"") -> None:
    """Write an intact archive whose header declares poses of so many frames."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("poses.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (frames, 156)})
        file.write(content)


def test_an_impossibly_large_array_shape_is_refused(tmp_path: Path) -> None:
    write_poses(tmp_path / "walk.npz", 10**30)
    with pytest.raises(InputError, match=r"walk\.npz: not an \.npz of plain arrays"):
        read_motion(tmp_path / "walk.npz")


def test_a_small_file_that_unpacks_beyond_the_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hnerf.render.motion.MAX_MOTION_BYTES", 10_000_000)
    write_poses(tmp_path / "bomb.npz", 10_000, bytes(10_000 * 156 * 8))
    assert (tmp_path / "bomb.npz").stat().st_size < 20_000
    with pytest.raises(InputError, match=r"bomb\.npz: unpacks to 12 MB; at most 10 MB"):
        read_motion(tmp_path / "bomb.npz")


def test_a_pipe_in_place_of_a_motion_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "dance.npz")
    with pytest.raises(InputError, match=r"dance\.npz: is no regular file"):
        read_motion(tmp_path / "dance.npz")


def test_a_folder_without_a_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no fitted body"):
        read_motion(tmp_path)
