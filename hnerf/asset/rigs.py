"""The rigs of an exported avatar, "full" and "game", with all its motions."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.asset.motions import Motion, continuous_quaternions, ground_transforms
from hnerf.asset.skeleton import Bones, Skeleton, full_skeleton, game_skeleton
from hnerf.asset.skinning import Skin, skinned, with_few_influences
from hnerf.body.rig import Rig
from hnerf.evenly_spaced import evenly_spaced

FULL, GAME = "full", "game"
GAME_INFLUENCES = 4
EYEBALL_WEIGHT = 0.99  # least weight of a point on an eyeball
BLOCK = 1024  # poses whose matrices are in memory at once; of half an hour at 120 a second, they would take 16 GB
FITTED_FRAMES = 64  # at most, evenly spaced; more hardly change the weights


@dataclass(frozen=True)
class RestSurface:
    """The surface at rest in stage axes: points_m (V, 3), and blend shapes shapes_m (K, V, 3), added to them by
    weight."""

    points_m: np.ndarray
    shapes_m: np.ndarray

    def shaped(self, weights: np.ndarray) -> np.ndarray:
        """Return the points (V, 3) with the blend shapes added by weights (K,)."""
        return self.points_m + np.tensordot(weights, self.shapes_m, 1)


@dataclass(frozen=True)
class JointMotion:
    """A motion of one skeleton. fps: of the time codes; codes (n,): the time codes; translations_m (n, J, 3) and
    quaternions (n, J, 4), as x y z w without sign jumps: relative to parents; shape_weights (n, K)."""

    fps: float
    codes: np.ndarray
    translations_m: np.ndarray
    quaternions: np.ndarray
    shape_weights: np.ndarray


@dataclass(frozen=True)
class StagedRig:
    """A skeleton, the skin that follows it, and its motions by name."""

    skeleton: Skeleton
    skin: Skin
    motions: dict[str, JointMotion]

    def stage(self, motion: str, rows: Sequence[int] | slice = slice(None)) -> np.ndarray:
        """Return the joints' transforms in the stage (n, J, 4, 4) at each time code of a motion, or only at some rows
        of them."""
        moving = self.motions[motion]
        return self.skeleton.placed(moving.translations_m[rows], moving.quaternions[rows])

    def surfaces_m(
        self, motion: str, rest: RestSurface, rows: Sequence[int] | slice = slice(None)
    ) -> Iterator[np.ndarray]:
        """Yield the surface (V, 3) at each time code of a motion, or only at some rows of them: with blend shapes, then
        skinned."""
        weights = self.motions[motion].shape_weights
        chosen = np.arange(len(weights))[rows]
        stage = (self.stage(motion, [row])[0] for row in chosen)  # all at once would take 13 KB a frame
        for transforms, points_m in posed_frames(self.skeleton, stage, rest, weights[chosen]):
            yield skinned(transforms, self.skin, points_m)


def posed_frames(
    skeleton: Skeleton, stage: Iterable[np.ndarray], rest: RestSurface, shape_weights: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the joints' transforms from rest to stage (J, 4, 4) and the points at rest (V, 3) with blend shapes. stage:
    the joints in the stage, (J, 4, 4) each."""
    inverse = np.linalg.inv(skeleton.bind)
    for transforms, weights in zip(stage, shape_weights, strict=True):
        yield transforms @ inverse, rest.shaped(weights)


def stage_rigs(
    rig: Rig, joints_m: np.ndarray, rest: RestSurface, motions: dict[str, Motion], floor_m: float, bones: Bones
) -> dict[str, StagedRig]:
    """Return both rigs made from a body model's rig. joints_m (S, 3): its joints at rest; motions: the first is the
    captured one, to which the game rig's weights are fitted; floor_m: the height of the ground in the stage."""
    parents = rig.parents.numpy()
    skin = without_lids(Skin(rig.skin_joints.numpy(), rig.skin_weights.double().numpy()), rig.joint_names, parents)
    full = full_skeleton(rig.joint_names, parents, joints_m, bones)
    skin = Skin(np.where(skin.weights > 0, skin.joints + 1, 0), skin.weights)  # a root joint was added before them
    game, taken_by = game_skeleton(full, bones)
    staged = {
        name: StagedRig(skeleton, found, _motions(skeleton, motions, parents, joints_m, floor_m))
        for name, skeleton, found in ((FULL, full, skin), (GAME, game, skin.moved_to(taken_by)))
    }
    staged[GAME] = _with_game_skin(staged[GAME], next(iter(motions)), rest)
    return staged


def without_lids(skin: Skin, joints: tuple[str, ...], parents: np.ndarray) -> Skin:
    """Return a skin in which only eyeballs follow the eyes, that is, points that follow one eye alone. If either eye
    has none, no point does. All other points follow the head instead, since lids must not turn with the eyes. joints:
    the body model's joint names."""
    eyes = [j for j, name in enumerate(joints) if name.startswith("eye.")]
    at_head = skin.moved_to(np.array([parents[j] if j in eyes else j for j in range(len(joints))]))
    of_eye = [((skin.joints == eye) & (skin.weights > EYEBALL_WEIGHT)).any(1) for eye in eyes]
    if not of_eye or not all(points.any() for points in of_eye):
        return at_head
    balls = np.any(of_eye, 0)[:, None]
    return Skin(np.where(balls, skin.joints, at_head.joints), np.where(balls, skin.weights, at_head.weights))


def _motions(
    skeleton: Skeleton, motions: dict[str, Motion], parents: np.ndarray, joints_m: np.ndarray, floor_m: float
) -> dict[str, JointMotion]:
    """Return the skeleton's motions. parents (S,), joints_m (S, 3): of the body model, at rest."""
    moving = {}
    for name, motion in motions.items():
        ground = ground_transforms(motion.transforms(parents[:1], joints_m[:1])[:, 0], floor_m)
        translations_m, quaternions = [], []
        for start in range(0, len(ground), BLOCK):
            rows = slice(start, start + BLOCK)
            local = skeleton.local(skeleton.posed(motion.transforms(parents, joints_m, rows), ground[rows]))
            turns = Rotation.from_matrix(local[..., :3, :3].reshape(-1, 3, 3))
            translations_m.append(local[..., :3, 3].copy())  # a view would keep the matrices
            quaternions.append(turns.as_quat().reshape(*local.shape[:2], 4))
        moves_m, turning = np.concatenate(translations_m), continuous_quaternions(np.concatenate(quaternions))
        moving[name] = JointMotion(motion.fps, motion.codes, moves_m, turning, motion.shape_weights)
    return moving


def _with_game_skin(game: StagedRig, captured: str, rest: RestSurface) -> StagedRig:
    """Return the rig with few influences per point, chosen so that the captured surfaces change least."""
    chosen = evenly_spaced(range(len(game.motions[captured].codes)), FITTED_FRAMES)
    weights = game.motions[captured].shape_weights[chosen]
    poses = posed_frames(game.skeleton, game.stage(captured, chosen), rest, weights)
    return StagedRig(game.skeleton, with_few_influences(game.skin, poses, GAME_INFLUENCES), game.motions)
