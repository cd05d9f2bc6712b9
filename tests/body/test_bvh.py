import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hnerf.body import bvh
from hnerf.body.bvh import Bvh, read_bvh, write_bvh
from hnerf.errors import InputError

ELBOW = """HIERARCHY
ROOT Upper arm
{
    OFFSET 1 2 3
    CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
    JOINT Fore
    {
        OFFSET 10 0 0
        CHANNELS 2 Yrotation Zrotation
        End Site
        {
            OFFSET 5 0 0
        }
    }
}
MOTION
Frames: 2
Frame Time: 0.04
0 0 0 0 0 0 0 0
4 5 6 90 0 90 0 90
"""


def written(folder: Path, text: str) -> Path:
    (folder / "a.bvh").write_text(text)
    return folder / "a.bvh"


def test_a_bvh_pose_by_hand(tmp_path: Path) -> None:
    """Rz(90) Ry(90) takes x to -z. At the elbow, y is the image of x under Rz(90)."""
    file = read_bvh(written(tmp_path, ELBOW))
    assert (file.names, file.parents.tolist(), file.frame_s) == (("Upper arm", "Fore"), [-1, 0], 0.04)
    np.testing.assert_allclose(file.rest(), [[1, 2, 3], [11, 2, 3]])
    turns, at = file.world()
    np.testing.assert_allclose(at[0], [[0, 0, 0], [10, 0, 0]])  # the root's position channels replace its offset
    np.testing.assert_allclose(at[1], [[4, 5, 6], [4, 5, -4]], atol=1e-9)
    # Rz(90) Ry(90) takes x to -z, y to -x and z to y. The elbow's own Rz(90) first takes its x to y.
    np.testing.assert_allclose(turns[1, 1] @ [1, 0, 0], [-1, 0, 0], atol=1e-9)


def test_writing_and_reading_preserves_the_motion(tmp_path: Path) -> None:
    file = read_bvh(written(tmp_path, ELBOW))
    fork = Bvh(("a", "b", "c", "d"), np.array([-1, 0, 0, 1]), np.eye(4)[:, :3], 0.1,
               np.tile(np.eye(4)[:, :3], (2, 1, 1)), file.rotations[:, [0, 1, 1, 0]])  # fmt: skip
    write_bvh(tmp_path / "b.bvh", fork, np.diag([7.0, 8, 9, 6])[:, :3])
    ends = re.findall(r"End Site\n\s*{\n\s*OFFSET (.*)", (tmp_path / "b.bvh").read_text())
    assert ends == ["0.000000 0.000000 0.000000", "0.000000 0.000000 9.000000"]  # of d and c
    again = read_bvh(tmp_path / "b.bvh")
    assert again.names == ("a", "b", "d", "c")  # depth first
    order = [0, 1, 3, 2]
    for found, true in zip(again.world(), fork.world(), strict=True):
        np.testing.assert_allclose(found, true[:, order], atol=1e-6)


def test_written_angles_do_not_jump_at_180_or_90_degrees(tmp_path: Path) -> None:
    """The root turns from 170 to 190 degrees while it leans by 2 and 3. A joint bends from 80 to 100 degrees while it
    is twisted by 4 and 5."""
    root = Rotation.from_euler("YZX", [[170, 2, 3], [190, 2, 3]], degrees=True).as_matrix()
    knee = Rotation.from_euler("XYZ", [[80, 4, 5], [100, 4, 5]], degrees=True).as_matrix()
    offsets = np.array([[0.0, 9, 0], [0, -1, 0]])
    leg = Bvh(("hip", "knee"), np.array([-1, 0]), offsets, 0.1, np.tile(offsets, (2, 1, 1)), np.stack([root, knee], 1))
    write_bvh(tmp_path / "b.bvh", leg, offsets)
    rows = np.loadtxt((tmp_path / "b.bvh").read_text().splitlines()[-2:])
    np.testing.assert_allclose(rows, [[0, 9, 0, 170, 2, 3, 80, 4, 5], [0, 9, 0, 190, 2, 3, 100, 4, 5]], atol=1e-5)
    np.testing.assert_allclose(read_bvh(tmp_path / "b.bvh").rotations, leg.rotations, atol=1e-6)


@pytest.mark.parametrize("raised_deg", [0, 20])
def test_curves_of_an_arm_that_swings_past_the_front_can_be_interpolated(raised_deg: int, tmp_path: Path) -> None:
    """The arm is raised about Z and swings about Y, the middle one of its angles, by 10 degrees a frame and past 90.
    X stays 0 and Z as raised, so that half-way between frames the angles' means have Y turned by 5 degrees more."""

    def swung(degrees: np.ndarray) -> Rotation:
        raised = Rotation.from_euler("z", raised_deg, degrees=True)
        return Rotation.from_euler("y", degrees[:, None], degrees=True) * raised

    degrees, at, turns = np.arange(54.0, 135, 10), np.zeros((9, 2, 3)), np.tile(np.eye(3), (9, 2, 1, 1))
    turns[:, 1] = swung(degrees).as_matrix()
    write_bvh(tmp_path / "b.bvh", Bvh(("hip", "arm"), np.array([-1, 0]), at[0], 0.1, at, turns), at[0])
    np.testing.assert_allclose(read_bvh(tmp_path / "b.bvh").rotations, turns, atol=1e-6)
    arm = np.loadtxt((tmp_path / "b.bvh").read_text().splitlines()[-9:])[:, 6:]
    np.testing.assert_allclose(arm, degrees[:, None] * [0, 1, 0] + [0, 0, raised_deg], atol=1e-5)
    halfway = Rotation.from_euler("XYZ", (arm[1:] + arm[:-1]) / 2, degrees=True)
    assert (halfway.inv() * swung(degrees[1:] - 5)).magnitude().max() < np.radians(0.1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HIERARCHY", "SOLID", "line 1: 'SOLID' is not expected here"),
        ("MOTION", "", "line 17: 'Frames: 2' is not expected here"),
        ("OFFSET 1 2 3", "OFFSET 1 2", "line 4: OFFSET is not three numbers"),
        ("OFFSET 1 2 3", "OFFSET 1 2 nan", "line 4: OFFSET is not three numbers"),
        ("OFFSET 1 2 3", "", "is not expected here"),
        ("CHANNELS 6", "CHANNELS 60", "line 5: CHANNELS does not list what it counts"),
        ("CHANNELS 6", "CHANNELS " + "9" * 5000, "line 5: CHANNELS does not list what it counts"),
        ("2 Yrotation Zrotation", "2 Yrotation Yrotation", "CHANNELS does not list"),
        ("Yrotation Zrotation", "Yrotation Wrotation", "CHANNELS does not list"),
        ("JOINT Fore", "ROOT Fore", "line 6: ROOT in the wrong place"),
        ("Frames: 2", "Frames: 3", "says 3 frames and has 2"),
        ("Frames: 2", "Frames: 999999999", "999999999 frames of 2 joints are too many"),
        ("Frames: 2", "Frames: two", "no `Frames:` and `Frame Time:`"),
        ("Frame Time: 0.04", "", "no `Frames:` and `Frame Time:`"),
        ("Frame Time: 0.04", "Frame Time: 0", "correct `Frames:` and `Frame Time:`"),
        ("4 5 6 90", "4 5 6 ninety", "frames are not numbers"),
        ("4 5 6 90", "4 5 6 nan", "frames are not 8 numbers"),
        ("4 5 6 90", "4 5 6", "frames are not numbers"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, ELBOW.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as refused:
        read_bvh(path)
    assert str(refused.value).startswith(str(path)) and "\n" not in str(refused.value)


def test_the_size_limit_counts_joints_without_channels(tmp_path: Path) -> None:
    """A file of 4 MB would need 144 GB: it has 2 million frames of 1000 joints, only one of which has a channel."""
    still = "".join(f"JOINT {number}\n{{\nOFFSET 0 1 0\n}}\n" for number in range(999))
    text = f"HIERARCHY\nROOT a\n{{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n{still}}}\nMOTION\nFrames: 2000000\n"
    with pytest.raises(InputError, match="2000000 frames of 1000 joints are too many"):
        read_bvh(written(tmp_path, text + "Frame Time: 0.04\n" + 9 * "0\n"))
    with pytest.raises(InputError, match="no joint has channels"):
        read_bvh(written(tmp_path, text.replace("CHANNELS 1 Xrotation\n", "") + "Frame Time: 0.04\n0\n"))


def test_hierarchies_with_too_many_joints_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bvh, "MAX_JOINTS", 1)
    with pytest.raises(InputError, match="more than 1 joints"):
        read_bvh(written(tmp_path, ELBOW))


def test_lines_after_the_frames_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bvh, "MAX_BYTES", 4_000_000)  # the memory that is reserved at first
    path = written(tmp_path, ELBOW + "12\n" * 1_000_000)
    tracemalloc.start()
    motion = read_bvh(path)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(motion.positions) == 2 and peak_bytes < 30_000_000  # ten times the file; its lines as strings are 60 MB


def test_blank_lines_are_allowed_anywhere(tmp_path: Path) -> None:
    spaced = read_bvh(written(tmp_path, ELBOW.replace("\n", "\r\n \r\n")))
    assert np.array_equal(spaced.positions, read_bvh(written(tmp_path, ELBOW)).positions)
