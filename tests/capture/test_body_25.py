"""The rows of BODY_25, as OpenPose numbers them (src/openpose/pose/poseParameters.cpp)."""

from hnerf.body.initial_root import HEAD_AND_TORSO, TORSO
from hnerf.body.limb_depths import LIMBS as LIMBS_WITH_DEPTH
from hnerf.capture.body_25 import FEET, LIMBS, Body25
from hnerf.synthetic.write import BODY_25_NAMES


def test_names_are_openposes() -> None:
    assert BODY_25_NAMES == (
        "Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip", "RHip", "RKnee",
        "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar", "LBigToe", "LSmallToe", "LHeel", "RBigToe",
        "RSmallToe", "RHeel",
    )  # fmt: skip
    assert list(Body25) == list(range(25))


def test_lines_and_groups_by_number() -> None:
    assert LIMBS == ((1, 2), (2, 3), (3, 4), (1, 5), (5, 6), (6, 7), (8, 9), (9, 10), (10, 11), (8, 12), (12, 13),
                     (13, 14), (1, 8), (0, 1))  # fmt: skip
    assert FEET == ((11, 24), (11, 22), (14, 21), (14, 19))
    assert LIMBS_WITH_DEPTH == ((2, 3), (3, 4), (5, 6), (6, 7), (9, 10), (10, 11), (12, 13), (13, 14), (9, 12), (2, 5))
    assert TORSO == (2, 5, 9, 12) and HEAD_AND_TORSO == (0, 1, 2, 5, 8, 9, 12, 15, 16, 17, 18)
