"""A made-up person of tubes in the file format of SMPL and SMPL-X: same keys, sizes and vertex numbers, but no SMPL
data."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

# Joints 0 to 21 of a T pose in SMPL's axes: Y up, facing +Z, origin at the chest; metres.
JOINTS_M = np.array([
    [0, -0.22, 0.03], [0.06, -0.31, 0.02], [-0.06, -0.31, 0.02], [0, -0.11, 0.0], [0.10, -0.70, 0.03],
    [-0.10, -0.70, 0.03], [0, 0.03, 0.0], [0.09, -1.10, 0.0], [-0.09, -1.10, 0.0], [0, 0.08, 0.03],
    [0.12, -1.16, 0.12], [-0.12, -1.16, 0.12], [0, 0.30, -0.01], [0.08, 0.20, 0.0], [-0.08, 0.20, 0.0],
    [0, 0.37, 0.04], [0.17, 0.22, 0.0], [-0.17, 0.22, 0.0], [0.43, 0.21, -0.02], [-0.43, 0.21, -0.02],
    [0.68, 0.22, -0.02], [-0.68, 0.22, -0.02],
])  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
ENDS = {0: 3, 3: 6, 6: 9, 9: 12, 12: 15, 1: 4, 2: 5, 4: 7, 5: 8, 7: 10, 8: 11, 13: 16, 14: 17, 16: 18, 17: 19, 18: 20,
        19: 21}  # fmt: skip
RADII_M = {0: 0.12, 3: 0.12, 6: 0.12, 9: 0.12, 12: 0.06, 15: 0.09, 1: 0.08, 2: 0.08, 4: 0.05, 5: 0.05}
LEFT_ELBOW = 18

# Vertex numbers in SMPL and in SMPL-X (vertex_ids of the smplx package), joint of the vertex, offset from that joint.
LANDMARKS = (
    (332, 9120, 15, (0, 0.03, 0.13)), (6260, 9929, 15, (-0.03, 0.07, 0.1)), (2800, 9448, 15, (0.03, 0.07, 0.1)),
    (4071, 616, 15, (-0.08, 0.05, 0.02)), (583, 6, 15, (0.08, 0.05, 0.02)),
    (3216, 5770, 10, (0, -0.02, 0.06)), (3226, 5780, 10, (0.05, -0.02, 0.03)), (3387, 8846, 7, (0, -0.07, -0.05)),
    (6617, 8463, 11, (0, -0.02, 0.06)), (6624, 8474, 11, (-0.05, -0.02, 0.03)), (6787, 8635, 8, (0, -0.07, -0.05)),
)  # fmt: skip


def made_up_smpl(kind: str = "smpl") -> dict[str, Any]:
    """Return the arrays of a model file. Shapes 0 to 3 make everything larger, the legs longer, the arms longer and the
    hips wider; the others change limbs a little. The only pose blend shape lifts the vertices of the left forearm when
    the left elbow turns."""
    joints_m, parents = _skeleton(kind)
    count = {"smpl": 6890, "smplx": 10475}[kind]
    tube = count // len(joints_m)
    moves = _joint_shapes(joints_m, parents, np.random.default_rng(0))  # (J, 3, 10)
    vertices, shapes = np.zeros((count, 3)), np.zeros((count, 3, 10))
    weights, regressor = np.zeros((count, len(joints_m))), np.zeros((len(joints_m), count))
    faces = []
    for j, start in enumerate(joints_m):
        end = ENDS.get(j)
        tip_m = joints_m[end] if end else start + _tip(j, start)
        ids, along, around = np.arange(j * tube, (j + 1) * tube), *_tube(start, tip_m, RADII_M.get(j, 0.035), tube)
        vertices[ids] = around
        shapes[ids] = moves[j] + along[:, None, None] * ((moves[end] if end else moves[j]) - moves[j])
        weights[ids, j] = 1
        first = ids[along == 0]
        regressor[j, first] = 1 / len(first)
        if parents[j] >= 0:
            weights[first, j], weights[first, parents[j]] = 0.5, 0.5
        faces.append(_tube_faces(ids, len(first)))
    rest = np.arange(len(joints_m) * tube, count)
    vertices[rest], weights[rest, 15] = joints_m[15], 1
    for smpl, smplx, joint, offset in LANDMARKS:
        v = smpl if kind == "smpl" else smplx
        regressor[:, v] = 0
        vertices[v], shapes[v], weights[v] = joints_m[joint] + offset, moves[joint], np.eye(len(joints_m))[joint]
    regressor /= regressor.sum(1, keepdims=True)
    posedirs = np.zeros((count, 3, 9 * (len(joints_m) - 1)))
    forearm = np.arange(LEFT_ELBOW * tube, (LEFT_ELBOW + 1) * tube)
    posedirs[forearm, 1, 9 * (LEFT_ELBOW - 1)] = 0.1
    return {
        "v_template": vertices,
        "f": np.concatenate(faces).astype(np.uint32),
        "shapedirs": shapes,
        "posedirs": posedirs,
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": np.array([[2**32 - 1, *parents[1:]], range(len(parents))], np.uint32),
    }


def write_smpl(path: Path, kind: str = "smpl") -> Path:
    """Write the model as .npz, or as .pkl with a sparse regressor like SMPL's own files."""
    data = made_up_smpl(kind)
    if path.suffix == ".npz":
        np.savez(path, **data, part2num=np.array({"head": 15}, object))
    else:
        data["J_regressor"] = scipy.sparse.csc_matrix(data["J_regressor"])
        path.write_bytes(pickle.dumps(data | {"bs_type": "lrotmin", "bs_style": "lbs"}, 2))
    return path


def _skeleton(kind: str) -> tuple[np.ndarray, list[int]]:
    """Return joint positions and parents: with hands for SMPL; with jaw, eyes and short fingers for SMPL-X."""
    if kind == "smpl":
        more = [(20, (0.08, 0, 0)), (21, (-0.08, 0, 0))]
    else:
        more = [(15, (0, 0.0, 0.05)), (15, (0.03, 0.07, 0.08)), (15, (-0.03, 0.07, 0.08))]
        more += [(wrist, (0.01 * side * k, 0, 0)) for wrist, side in ((20, 1), (21, -1)) for k in range(1, 16)]
    places = [JOINTS_M[parent] + offset for parent, offset in more]
    return np.concatenate([JOINTS_M, places]), [*PARENTS, *(parent for parent, _ in more)]


def _joint_shapes(joints_m: np.ndarray, parents: list[int], random: np.random.Generator) -> np.ndarray:
    """Return the displacement of each joint by each of ten shapes, (J, 3, 10): each bone lengthens by a fraction."""
    shares = random.normal(0, 0.01, (len(joints_m), 10))
    shares[:, 0] = 0.05
    shares[:, 1] = np.isin(range(len(joints_m)), (4, 5, 7, 8)) * 0.08
    shares[:, 2] = np.isin(range(len(joints_m)), (18, 19, 20, 21)) * 0.08
    shares[:, 3] = np.isin(range(len(joints_m)), (1, 2, 16, 17)) * 0.15
    shares[1:3, 4:] = shares[2, 4:]
    moves = np.zeros((len(joints_m), 3, 10))
    moves[0] = joints_m[0][:, None] * shares[0]
    for j, parent in enumerate(parents[1:], 1):
        twin = {5: 4, 8: 7, 19: 18, 21: 20, 17: 16, 14: 13, 11: 10}.get(j, j)  # both sides have the same fraction
        moves[j] = moves[parent] + (joints_m[j] - joints_m[parent])[:, None] * shares[twin]
    return moves


def _tip(joint: int, start: np.ndarray) -> np.ndarray:
    """Return the vector from a joint without children to its end."""
    if joint == 15:
        return np.array([0, 0.2, 0])
    if joint in (10, 11):
        return np.array([0, 0, 0.06])
    if joint in (20, 21):
        return np.array([0.15 * np.sign(start[0]), 0, 0])
    return np.array([0.02 * (np.sign(start[0]) or 1), 0, 0])


def _tube(start: np.ndarray, end: np.ndarray, radius_m: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a tube of seven rings: the fraction along its length (N,) and positions (N, 3). Vertices that do not fill
    a ring lie at its end."""
    around = count // 7
    along = np.minimum(np.arange(count) // around, 6) / 6
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0, 0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0, 0])
    side /= np.linalg.norm(side)
    angle = 2 * np.pi * (np.arange(count) % around) / around
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
    return along, start + along[:, None] * (end - start) + radius_m * ring


def _tube_faces(ids: np.ndarray, around: int) -> np.ndarray:
    """Return the outward-facing triangles between rings."""
    a = ids[: 6 * around].reshape(6, around)
    b, c, d = np.roll(a, -1, 1), a + around, np.roll(a, -1, 1) + around
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
