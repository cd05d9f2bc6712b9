import itertools

import numpy as np
import pytest

from hnerf.asset.rigs import without_lids
from hnerf.asset.skinning import Skin, skinned, with_few_influences


def moves(*offsets_m: tuple[float, float, float]) -> np.ndarray:
    """Return transforms (J, 4, 4) that translate by offsets."""
    transforms = np.tile(np.eye(4), (len(offsets_m), 1, 1))
    transforms[:, :3, 3] = offsets_m
    return transforms


def test_skinned_points_by_hand() -> None:
    """One joint stays; the other turns by a quarter about z and moves by 1 along x."""
    quarter = np.array([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    skin = Skin(np.array([[0, 1], [1, 0]]), np.array([[0.75, 0.25], [1.0, 0]]))
    found = skinned(np.stack([np.eye(4), quarter]), skin, np.array([[4.0, 0, 0], [4, 0, 0]]))
    np.testing.assert_allclose(found, [[0.75 * 4 + 0.25, 1, 0], [1, 4, 0]])


def test_weights_of_merged_joints_add_up() -> None:
    skin = Skin(np.array([[1, 2, 3], [3, 0, 0]]), np.array([[0.5, 0.3, 0.2], [1.0, 0, 0]]))
    found = skin.moved_to(np.array([0, 1, 0, 0]))  # joints 2 and 3 are merged into 0
    np.testing.assert_array_equal(found.joints, [[1, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(found.weights, [[0.5, 0.5, 0], [1, 0, 0]])
    assert found.influences == 2


def test_eye_joints_move_only_eyeballs_not_lids() -> None:
    """The skin has two lids and one or two eyeballs. With only one eyeball, its joint is not used either, because the
    face would be one-eyed."""
    joints, parents = ("head", "eye.L", "eye.R"), np.array([-1, 0, 0])
    lids = Skin(np.array([[1, 0], [2, 0]]), np.array([[0.6, 0.4], [0.7, 0.3]]))
    np.testing.assert_array_equal(without_lids(lids, joints, parents).joints, 0)
    np.testing.assert_allclose(without_lids(lids, joints, parents).weights, [[1, 0], [1, 0]])
    for balls, expected in (([1], [0, 0, 0]), ([1, 2], [0, 0, 1, 2])):
        ends = np.array([[ball, 0] for ball in balls])
        both = Skin(np.vstack([lids.joints, ends]), np.vstack([lids.weights, [[1.0, 0]] * len(balls)]))
        np.testing.assert_array_equal(without_lids(both, joints, parents).joints[:, 0], expected)


def test_joints_that_move_alike_are_merged_without_loss() -> None:
    """Joints 1 and 2 move alike in all poses, so one joint can take the weights of both."""
    skin = Skin(np.array([[1, 2, 0]]), np.array([[0.4, 0.35, 0.25]]))
    poses = [(moves((0, 0, 0), (1, y, 0), (1, y, 0)), np.zeros((1, 3))) for y in (0.0, 2.0)]
    found = with_few_influences(skin, iter(poses), 2)
    np.testing.assert_array_equal(np.sort(found.joints), [[0, 1]])
    np.testing.assert_allclose(found.weights, [[0.75, 0.25]], atol=1e-6)


def test_a_joint_of_zero_weight_stays_unused() -> None:
    """Joint 0 only pads the row, although it moves exactly as the blend of the three others does."""
    skin = Skin(np.array([[1, 2, 3, 0]]), np.array([[1 / 3, 1 / 3, 1 / 3, 0]]))
    poses = [(moves((1 / 3, 1 / 3, 1 / 3), (1, 0, 0), (0, 1, 0), (0, 0, 1)), np.zeros((1, 3)))]
    found = with_few_influences(skin, iter(poses), 2)
    assert found.joints.min() > 0
    np.testing.assert_allclose(found.weights, [[0.5, 0.5]], atol=1e-6)


RANDOM = [np.random.default_rng(seed).normal(size=(3, 4, 3)) for seed in range(4)]
# One pose in which the line through the last two joints comes nearest, but only outside the segment between them.
OUTSIDE = np.array([[[3.0, -2, -1], [-2, -3, -3], [-3, 2, 2], [-2, 1, 1]]])


@pytest.mark.parametrize("offsets_m", [*RANDOM, OUTSIDE])
def test_the_best_subset_is_found(offsets_m: np.ndarray) -> None:
    """The result is as good as the best of many weights on any two of four joints."""
    poses = [(moves(*pose), np.zeros((1, 3))) for pose in offsets_m]
    skin = Skin(np.array([[0, 1, 2, 3]]), np.array([[0.4, 0.3, 0.2, 0.1]]))
    found = with_few_influences(skin, iter(poses), 2)
    assert found.influences <= 2

    def error(tried: Skin) -> float:
        off = [skinned(pose, tried, at) - skinned(pose, skin, at) for pose, at in poses]
        return float(np.square(off).sum())

    pairs = itertools.combinations(range(4), 2)
    tried = [Skin(np.array([pair]), np.array([[w, 1 - w]])) for pair in pairs for w in np.linspace(0, 1, 51)]
    assert error(found) <= min(map(error, tried)) * 1.001


def test_points_with_few_influences_keep_their_weights() -> None:
    skin = Skin(np.array([[2, 1, 0, 0], [3, 1, 2, 0]]), np.array([[0.6, 0.4, 0, 0], [0.4, 0.3, 0.2, 0.1]]))
    poses = [(moves((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)), np.zeros((2, 3)))]
    found = with_few_influences(skin, iter(poses), 2)
    np.testing.assert_array_equal(found.joints[0], [2, 1])
    np.testing.assert_allclose(found.weights[0], [0.6, 0.4])
