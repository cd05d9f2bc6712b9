import numpy as np
import torch

from hnerf.asset.extreme_poses import moved_by
from hnerf.body.anny import ADULT, BETA_NAMES, anny_rig
from hnerf.body.physiques import physiques_m
from hnerf.body.rig import Rig


def test_physiques_match_their_names_at_belly_and_thighs(rig: Rig) -> None:
    moved = physiques_m(rig)
    assert list(moved) == ["heavy", "muscular", "slim"]
    assert all(m.shape == (len(rig.vertices_m), 3) and m.dtype == np.float32 for m in moved.values())
    x, y, z = rig.vertices_m.numpy().T
    pelvis_m = float(rig.joints_m[rig.joint_names.index("spine05"), 2])
    belly = (np.abs(x) < 0.05) & (np.abs(z - pelvis_m - 0.05) < 0.05) & (y < 0)  # on the front
    front = {name: m[belly, 1].mean() for name, m in moved.items()}
    assert front["heavy"] < -0.03 and front["slim"] > 0.005
    assert front["heavy"] < front["muscular"] < front["slim"]
    thigh = moved_by(rig, ("upperleg01.L", "upperleg02.L"))
    across_m = rig.vertices_m[thigh, :2].numpy()
    grown_m = {n: (across_m + m[thigh, :2]).std(0).sum() - across_m.std(0).sum() for n, m in moved.items()}
    assert grown_m["slim"] < -0.005 and min(grown_m["muscular"], grown_m["heavy"]) > 0.005


def test_physiques_exclude_the_displacement_of_joints(rig: Rig) -> None:
    heavy, average = (torch.tensor(ADULT) for _ in range(2))
    heavy[BETA_NAMES.index("weight")], heavy[BETA_NAMES.index("muscle")] = 1, 0
    differing_m = (anny_rig(heavy).vertices_m - anny_rig(average).vertices_m).numpy()
    moved_m = physiques_m(rig)["heavy"]
    joint_m = anny_rig(heavy).joints_m - anny_rig(average).joints_m
    np.testing.assert_allclose(moved_m, differing_m - (rig.dense_weights @ joint_m).numpy(), atol=1e-6)
    assert np.abs(moved_m - differing_m).max() > 0.005


def test_physiques_depend_on_age_but_not_on_muscle_weight_or_local_changes(rig: Rig) -> None:
    beta = torch.tensor(ADULT)
    beta[BETA_NAMES.index("weight")] = 0.9
    beta[BETA_NAMES.index("measure-hips-circ")] = -0.8
    for name, moved_m in physiques_m(anny_rig(beta)).items():
        np.testing.assert_array_equal(moved_m, physiques_m(rig)[name])
    beta[BETA_NAMES.index("age")] = 0.4
    child_m = physiques_m(anny_rig(beta))["heavy"]
    assert np.abs(child_m).max() < 0.9 * np.abs(physiques_m(rig)["heavy"]).max()
