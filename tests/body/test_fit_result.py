from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body import fit_result
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from tests.body.boxes import box_rig
from tests.body.two_bone import two_bone_rig


def test_a_saved_fit_is_loaded_and_its_file_has_the_documented_arrays(tmp_path: Path) -> None:
    rig = two_bone_rig().to(dtype=torch.float32)
    theta = torch.zeros(2, 3, 3)
    theta[1, 1, 1] = torch.pi / 2
    root = torch.eye(4).repeat(2, 1, 1)
    root[:, 0, 3] = 5
    BodyFit(rig, (3, 7), theta, root).save(tmp_path)
    loaded = BodyFit.load(tmp_path)
    assert loaded.frames == (3, 7) and loaded.index(7) == 1
    assert torch.equal(loaded.theta, theta) and torch.equal(loaded.root, root)
    with np.load(tmp_path / "body.npz", allow_pickle=False) as stored:
        assert set(stored) == {"theta", "T", "beta", "frames", "vertices", "faces", "joints", "joint_names"}
        np.testing.assert_allclose(
            stored["joints"][:, 2], [[5, 0, 2], [6, 0, 1]], atol=1e-6
        )  # the tip, with the elbow straight and bent
        np.testing.assert_allclose(stored["vertices"][1, 3], [6.5, 0, 1], atol=1e-6)
        assert stored["joint_names"].tolist() == ["root", "elbow", "tip"]
        np.testing.assert_allclose(stored["beta"], [0.3])
    box_rig().save(tmp_path / "rig.npz")
    with pytest.raises(ValueError, match="are not 2 poses of its rig"):
        BodyFit.load(tmp_path)


def test_all_tensors_of_a_fit_move_to_a_device() -> None:
    fit = BodyFit(two_bone_rig(), (3,), torch.zeros(1, 3, 3), torch.eye(4)[None]).to("meta")
    assert fit.frames == (3,)
    assert {tensor.device.type for tensor in (fit.theta, fit.root, fit.rig.vertices_m, fit.rig.faces)} == {"meta"}


def test_a_long_fit_is_posed_a_part_of_its_frames_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """All at once, skinning a thousand frames takes a gigabyte beside the vertices."""
    counts: list[int] = []
    root = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    root[:, 0, 3] = torch.arange(5)
    fit = BodyFit(two_bone_rig(), (0, 1, 2, 3, 4), torch.zeros(5, 3, 3, dtype=torch.float64), root)
    whole_m = fit.vertices_m()
    monkeypatch.setattr("hnerf.body.fit_result.POSED_AT_ONCE", 2)
    pose_some = fit_result.pose_vertices

    def counted(rig: Rig, theta: torch.Tensor, root: torch.Tensor) -> torch.Tensor:
        counts.append(len(theta))
        return pose_some(rig, theta, root)

    monkeypatch.setattr(fit_result, "pose_vertices", counted)
    assert torch.equal(fit.vertices_m(), whole_m) and counts == [2, 2, 1]
