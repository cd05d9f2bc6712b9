import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hnerf.asset import comparison
from hnerf.asset.albedo import Albedo
from hnerf.asset.comparison import compare_with_field, comparison_figures, require_close
from hnerf.asset.light import Light
from hnerf.asset.splats import surface_splats
from hnerf.asset.staging import StagedAvatar
from hnerf.avatar.avatar import Rendering
from hnerf.body.descriptor import normals_of
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.masks import Masks, encode
from hnerf.errors import InvalidAsset
from hnerf.geometry.camera import Camera
from hnerf.geometry.mesh_queries import Surface
from tests.asset.figure import bending_body, capture, side_camera
from tests.asset.stand_in import StandInAvatar

PERSON = np.array([110, 110, 110])
WHOLE = (slice(120, 270), slice(250, 400))  # rows and columns of the mask: 150 px wide and high


class GreyField(StandInAvatar):
    """A field that renders the same grey at every pixel."""

    level, alpha = 90, 1.0

    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        shape = camera.height_px, camera.width_px
        return Rendering(torch.full((*shape, 3), self.level / 255), torch.full(shape, self.alpha), torch.ones(shape))


@pytest.fixture
def recorded(tmp_path: Path) -> Capture:
    """Return a capture whose photographs are uniformly grey."""
    found = dataclasses.replace(capture(), root=tmp_path)
    for frame in found.train_frames:
        write_image(tmp_path / f"images/01/{frame:06d}.png", np.full((480, 640, 3), PERSON, np.uint8))
    return found


def square() -> np.ndarray:
    mask = np.zeros((480, 640), bool)
    mask[WHOLE] = True
    return mask


def masks_of(frames: tuple[int, ...]) -> Masks:
    return Masks({("01", frame): encode(square()) for frame in frames}, {})


def grey(staged: StagedAvatar, level: int) -> StagedAvatar:
    return dataclasses.replace(staged, texture=np.full((64, 64, 3), level, np.uint8))


def test_the_field_is_scored_under_the_mask_in_its_padded_box(recorded: Capture, staged: StagedAvatar) -> None:
    (found,) = compare_with_field(recorded, masks_of((4,)), GreyField(bending_body()), grey(staged, 100))
    assert (found.view.camera, found.view.frame, found.photograph.shape) == ("01", 4, (190, 190, 3))
    # The field shows 90 everywhere: 20 too dark inside the mask, 90 too bright in the 20 px around it.
    inside = 150**2 / 190**2
    error = inside * (20 / 255) ** 2 + (1 - inside) * (90 / 255) ** 2
    assert found.scores["field"]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
    assert found.scores["field"]["mask_iou"] == pytest.approx(inside)


def test_the_asset_is_rendered_with_pose_and_exposure_of_camera_and_frame(
    recorded: Capture, staged: StagedAvatar
) -> None:
    avatar = GreyField(bending_body(), gains={"01": (0.5, 1.0, 3.0)})
    (found,) = compare_with_field(recorded, masks_of((4,)), avatar, grey(staged, 100))
    points_m = staged.points_m[list(staged.frames).index(4)] @ staged.stage_from_world
    seen_px, _ = side_camera().project(points_m)
    covered = np.argwhere(found.renders["asset"][..., 3] > 127)[:, ::-1]
    # Single points have noise of 1 cm, which is 1 px.
    np.testing.assert_allclose(covered.min(0), seen_px.min(0) - (230, 100), atol=3)  # the box's upper left corner
    np.testing.assert_allclose(covered.max(0), seen_px.max(0) - (230, 100), atol=3)
    column, row = covered.mean(0).astype(int)
    assert found.renders["asset"][row, column].tolist() == [50, 100, 255, 255]


def test_the_albedo_is_rendered_in_its_light_with_the_cameras_exposure(recorded: Capture, staged: StagedAvatar) -> None:
    light = Light(np.array([0.5, 0, -0.3, 0, 0, 0, 0, 0, 0]), 20.0)  # one half on average, less from +Z of the stage
    albedo = Albedo(np.full((64, 64, 3), 188, np.uint8), light)  # 0.5 in linear light
    avatar = GreyField(bending_body(), gains={"01": (0.5, 1.0, 1.2)})
    (found,) = compare_with_field(recorded, masks_of((4,)), avatar, dataclasses.replace(staged, albedo=albedo))
    points_m = staged.points_m[list(staged.frames).index(4)] @ staged.stage_from_world
    shown = found.renders["albedo"]
    row, column = np.argwhere(shown[..., 3] == 255).mean(0).astype(int)
    surface = Surface.of(points_m, staged.faces)
    hits = surface.cast(*side_camera().rays(np.array([[column + 230.0, row + 100]])))  # from the box's corner
    normal = hits.barycentric[0] @ normals_of(points_m, staged.faces)[staged.faces[hits.face[0]]]
    linear = 0.5 * (0.5 + 2 / 3 * -0.3 * 3**0.5 * (staged.stage_from_world @ normal)[2] / np.linalg.norm(normal))
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055) * np.array([0.5, 1.0, 1.2])
    np.testing.assert_allclose(shown[row, column, :3], expected, atol=6)
    assert expected[1] < 130  # darker than the unlit albedo
    both = {"asset", "albedo", "field"}
    assert both == found.scores.keys() and both < comparison_figures([found]).keys()


def test_splats_look_like_the_asset_and_are_scored_against_photograph_and_field(
    recorded: Capture, staged: StagedAvatar
) -> None:
    avatar, shown = GreyField(bending_body(), gains={"01": (0.5, 1.0, 3.0)}), grey(staged, 100)
    (found,) = compare_with_field(recorded, masks_of((4,)), avatar, shown, surface_splats(shown, 20_000))
    inside = found.renders["asset"][..., 3] == 255
    assert np.abs(found.renders["splats"][inside].astype(int) - (50, 100, 255, 255)).mean() < 3
    covered = [found.renders[name][..., 3] > 127 for name in ("splats", "asset")]
    assert np.mean(covered[0] != covered[1]) < 0.02 * inside.mean() + 0.003
    assert found.scores["splats"]["psnr"] == pytest.approx(found.scores["asset"]["psnr"], abs=0.5)
    off = (found.renders["splats"][..., :3].astype(float) - 90) / 255  # the field is uniformly grey
    assert found.scores["splats"]["psnr_to_field"] == pytest.approx(-10 * np.log10((off**2).mean()), abs=1e-3)
    figures = comparison_figures([found])
    assert figures["splats"] == found.scores["splats"] and list(figures["below_field"]) == ["psnr", "ssim", "mask_iou"]
    assert figures["per_image"][0]["splats_psnr_to_field"] == found.scores["splats"]["psnr_to_field"]


def test_large_boxes_are_scaled_down(recorded: Capture, staged: StagedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "LONGEST_PX", 95)
    (found,) = compare_with_field(recorded, masks_of((4,)), GreyField(bending_body()), grey(staged, 100))
    assert found.photograph.shape == (95, 95, 3) and {r.shape for r in found.renders.values()} == {(95, 95, 4)}
    assert found.scores["field"]["mask_iou"] == pytest.approx(75**2 / 95**2)
    # The column, 36 cm by 1.7 m at 5 m, covers 36 px by 136 px of the photograph.
    assert (found.renders["asset"][..., 3] > 127).sum() == pytest.approx(18 * 68, rel=0.1)


def test_a_person_cut_to_a_narrow_strip_is_scored(
    recorded: Capture, staged: StagedAvatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The box is 28 px wide and 470 px high; scaled to a longest side of 150 px it would be 9 px wide."""
    monkeypatch.setattr(comparison, "LONGEST_PX", 150)
    edge = np.zeros((480, 640), bool)
    edge[:450, :8] = True
    masks = Masks({("01", 4): encode(edge)}, {})
    (found,) = compare_with_field(recorded, masks, GreyField(bending_body()), grey(staged, 100))
    assert min(found.photograph.shape[:2]) >= 11 and np.isfinite(found.scores["asset"]["ssim"])


def test_a_mask_of_specks_that_vanish_when_it_is_shrunk_has_finite_scores(
    recorded: Capture, staged: StagedAvatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The box is wider than LONGEST_PX, and nothing is rendered in it."""
    specks = np.zeros((480, 640), bool)
    specks[[0, 40], [0, 639]] = True
    monkeypatch.setattr(GreyField, "alpha", 0.0)
    (found,) = compare_with_field(recorded, Masks({("01", 4): encode(specks)}, {}), GreyField(bending_body()), staged)
    assert found.scores["field"]["mask_iou"] == 1.0 and np.isfinite(found.scores["asset"]["mask_iou"])


@pytest.mark.parametrize(
    ("masked", "chosen", "of"), [(None, "01", "training"), (255, "04", "test"), (0, "01", "training")]
)
def test_test_cameras_with_masks_of_the_person_come_first(
    masked: int | None, chosen: str, of: str, recorded: Capture, staged: StagedAvatar
) -> None:
    """Of three test cameras only the last has masks, if any, and they may say that the person is out of view."""
    further = {name: dataclasses.replace(side_camera(), name=name) for name in ("02", "03", "04")}
    tested = dataclasses.replace(recorded, cameras=recorded.cameras | further, test_cameras=tuple(further))
    for frame in recorded.train_frames if masked is not None else ():
        write_image(tested.root / f"images/04/{frame:06d}.png", np.full((480, 640, 3), 9, np.uint8))
        write_image(tested.root / f"masks/04/{frame:06d}.png", np.where(square(), masked, 0).astype(np.uint8))
    found = compare_with_field(tested, masks_of(recorded.train_frames), GreyField(bending_body()), staged)
    assert [(c.view.camera, c.view.frame) for c in found] == [(chosen, frame) for frame in recorded.train_frames]
    assert comparison_figures(found)["cameras"] == of


def test_without_any_mask_a_reason_is_given_and_the_export_passes(recorded: Capture, staged: StagedAvatar) -> None:
    nobody = Masks({("01", 3): encode(np.zeros((480, 640), bool))}, {})
    for masks in (nobody, Masks({}, {})):
        figures = comparison_figures(compare_with_field(recorded, masks, GreyField(bending_body()), staged))
        assert figures == {"images": 0, "reason": "no image has a mask of the person"}
        require_close("ada", "registered", figures, allow_poor=False)


def test_figures_are_means_and_the_assets_deficit_below_the_field(recorded: Capture, staged: StagedAvatar) -> None:
    (one,) = compare_with_field(recorded, masks_of((4,)), GreyField(bending_body()), staged)
    scored = [
        dataclasses.replace(one, scores={"asset": {"psnr": a, "ssim": 0.9}, "field": {"psnr": f, "ssim": 0.95}})
        for a, f in ((20.0, 25.0), (26.0, 29.0))
    ]
    found = comparison_figures(scored)
    assert (found["images"], found["cameras"]) == (2, "training")
    assert (found["asset"]["psnr"], found["field"]["psnr"], found["below_field"]["psnr"]) == (23.0, 27.0, 4.0)
    assert found["below_field"]["ssim"] == pytest.approx(0.05)
    assert found["per_image"][1] == {
        "camera": "01", "frame": 4, "asset_psnr": 26.0, "asset_ssim": 0.9, "field_psnr": 29.0, "field_ssim": 0.95,
    }  # fmt: skip


def test_an_asset_far_below_its_field_is_refused_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    def figures(below_db: float) -> dict[str, Any]:
        return {"images": 6, "cameras": "training", "asset": {"psnr": 29.5 - below_db}, "field": {"psnr": 29.5}}

    require_close("ada", "registered", figures(4.0), allow_poor=False)
    with pytest.raises(InvalidAsset) as refused:
        require_close("ada", "registered", figures(4.1), allow_poor=False)
    line = str(refused.value)
    assert line.startswith(
        "ada: the asset with the registered mesh is below its field: captured look 4.1 dB (field 29.5 dB, mean of 6"
    )
    assert "asset.allow_poor=true (`hnerf export --allow-poor`)" in line and "\n" not in line
    assert not caplog.records
    require_close("ada", "registered", figures(4.1), allow_poor=True)
    assert "ada: the asset with the registered mesh is below its field: captured look 4.1 dB" in caplog.text


def test_one_good_look_is_enough_and_a_poor_one_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    def figures(captured_db: float, albedo_db: float) -> dict[str, Any]:
        psnr = {"asset": 29.5 - captured_db, "albedo": 29.5 - albedo_db, "field": 29.5}
        return {"images": 6, "cameras": "test"} | {shown: {"psnr": value} for shown, value in psnr.items()}

    require_close("ada", "captured", figures(3.9, 3.8), allow_poor=False)
    assert not caplog.records
    require_close("ada", "captured", figures(7.1, 1.2), allow_poor=False)
    assert "captured look 7.1 dB and albedo in its own light 1.2 dB" in caplog.text
    assert "; use the albedo in its own light" in caplog.text
    require_close("ada", "captured", figures(1.2, 7.1), allow_poor=False)
    assert "; use the captured look" in caplog.text
    with pytest.raises(InvalidAsset, match=r"captured look 7\.1 dB and albedo in its own light 4\.1 dB"):
        require_close("ada", "captured", figures(7.1, 4.1), allow_poor=False)
