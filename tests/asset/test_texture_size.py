"""The texture's size for walls in front of cameras, worked out by hand."""

import dataclasses

import numpy as np
import pytest
import trimesh

from hnerf.asset.correctives import as_they_are
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.texture import UvLayout
from hnerf.asset.texture_size import finest_pixel_m, fitting_px, texture_size, texture_width_m
from hnerf.asset.topologies import AssetMesh
from hnerf.body.base_mesh import BaseMesh
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from tests.asset.figure import capture, column_rig

WALL = np.array([[0, 1, 2], [0, 2, 3]])
CHART = UvLayout(np.float32([[0, 0], [0.5, 0], [0.5, 1], [0, 1]]), WALL)  # half of the texture


def wall(width_m: float, height_m: float, depth_m: float) -> np.ndarray:
    """Return the corners (4, 3) of a wall that faces a camera at the origin."""
    return np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]]) * (width_m / 2, height_m / 2, 0) + (0, 0, depth_m)


def papered(corners_m: np.ndarray) -> AssetMesh:
    """Return a mesh of one wall with its chart."""
    rig = clothed_rig(column_rig(), trimesh.Trimesh(corners_m, WALL, process=False))
    return AssetMesh(rig, as_they_are, 2, BaseMesh(rig, np.zeros(4, bool), 2, CHART.uvs, CHART.face_uvs, {}, {}))


def filmed(focal_px: float, size_px: tuple[int, int]) -> Capture:
    """Return a capture by a camera at the origin, looking along z."""
    K = np.array([[focal_px, 0, (size_px[0] - 1) / 2], [0, focal_px, (size_px[1] - 1) / 2], [0, 0, 1]])
    return dataclasses.replace(capture(), cameras={"01": Camera("01", K, np.eye(3), np.zeros(3), *size_px)})


@pytest.mark.parametrize(
    ("width_m", "pixel_m", "px"),
    [
        (2.0, 0.004, 1024),  # 2 * 2 m / 4 mm = 1000 texels
        (2.0, 0.0028, 1024),  # 1429 texels: 1.40 times 1024, and 2048 is 1.43 times them
        (2.0, 0.0027, 2048),  # 1481 texels: 1.45 times 1024, and 2048 is 1.38 times them
        (2.0, 0.008, 1024),  # 500 texels
        (2.0, 0.0001, 8192),  # 40 000 texels
        (2.0, None, 1024),
    ],
)
def test_a_texel_is_about_half_a_pixel(width_m: float, pixel_m: float | None, px: int) -> None:
    assert fitting_px(width_m, pixel_m, 1) == px


def test_the_texture_leaves_memory_for_photographs_of_several_frames() -> None:
    """2^29 texels are 32 photographs of 4096 px. With 8 cameras, these are four frames; with 9, they are too few. A
    recording of two frames has 32 photographs with 16 cameras. Of very many cameras, not even the smallest texture can
    have four."""
    for photographs, px in {8: 8192, 32: 4096, 33: 2048, 128: 2048, 129: 1024, 10_000: 1024}.items():
        assert fitting_px(2, 0.0001, photographs) == px
    for cameras, frames, px in ((8, 5, 4096), (9, 5, 2048), (16, 2, 4096)):
        many = dataclasses.replace(filmed(4000, (2160, 3840)), train_cameras=("01",) * cameras)
        size, _ = texture_size(many, [wall(1, 2, 2)] * frames, papered(wall(1, 2, 0)), None)
        assert size.px == px


@pytest.mark.parametrize(
    ("focal_px", "size_px", "px"),
    [(250, (144, 256), 1024), (2000, (1080, 1920), 4096), (4000, (2160, 3840), 8192)],
)
def test_the_texture_of_a_wall_fits_the_recording(focal_px: float, size_px: tuple[int, int], px: int) -> None:
    """A wall 1 m wide and 2 m high, 2 m away, fills half of the texture, which is thus 2 m wide on it. With focal
    lengths as in images of 256 px, 1080p and 4K, a pixel is 8, 1 and 0.5 mm wide: 500, 4000 and 8000 texels are half as
    wide. The smallest texture has 1024."""
    size, layout = texture_size(filmed(focal_px, size_px), [wall(1, 2, 2)], papered(wall(1, 2, 0)), None)
    assert layout.uvs is CHART.uvs and size.px == px
    shown_mm = {"texture_px": px, "texel_mm": 2000 / px, "source_pixel_mm": 2000 / focal_px}
    assert size.figures() == pytest.approx(shown_mm, rel=1e-5)


def test_a_size_that_is_set_is_kept() -> None:
    size, _ = texture_size(filmed(2000, (1080, 1920)), [wall(1, 2, 2)], papered(wall(1, 2, 0)), 100)
    assert (size.px, size.texel_m, size.pixel_m) == pytest.approx((100, 0.02, 0.001), rel=1e-5)


def test_charts_of_a_mesh_without_texture_coordinates_are_packed_for_the_chosen_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sizes_px: list[int] = []
    monkeypatch.setattr("hnerf.asset.topologies.unwrap", lambda v, f, px: sizes_px.append(px) or CHART)
    bare = dataclasses.replace(papered(wall(1, 2, 0)), base=None)
    for focal_px, packed_px in ((2000, [1024, 4096]), (500, [1024])):
        sizes_px.clear()
        assert texture_size(filmed(focal_px, (1080, 1920)), [wall(1, 2, 2)], bare, None)[0].px == packed_px[-1]
        assert sizes_px == packed_px


@pytest.mark.parametrize(("share", "pixel_m"), [(0.04, 0.004), (0.06, 0.002)])
def test_the_finest_pixels_are_those_of_more_than_a_twentieth(share: float, pixel_m: float) -> None:
    """At a focal length of 500 px, a pixel is 4 mm wide on a wall 2 m away, and 2 mm on a smaller one 1 m away. Walls
    that are behind the camera, outside its image or turned away from it do not count, although they are closer."""
    near, far = wall(share, 1, 1), wall(1 - share, 1, 2)
    unseen = [wall(1, 1, -0.5)[::-1], np.array([5.0, 0, 0]) + wall(1, 1, 0.5), wall(1, 1, 0.5)[::-1]]
    surface_m = np.concatenate([near, far, *unseen])
    faces = np.concatenate([WALL + 4 * k for k in range(5)])
    assert finest_pixel_m(filmed(500, (1001, 1001)), [surface_m], faces) == pytest.approx(pixel_m)
    assert finest_pixel_m(filmed(500, (1001, 1001)), [np.concatenate(unseen)], faces[:6]) is None
    assert finest_pixel_m(filmed(500, (1001, 1001)), [], faces) is None


def test_all_training_cameras_and_frames_count() -> None:
    """The wall is 2 m away in one frame and 3 m in the other, and 1 m farther from a second camera."""
    one = filmed(1000, (2001, 2001))
    behind = dataclasses.replace(one.cameras["01"], name="02", t_m=np.array([0, 0, 1.0]))
    both = dataclasses.replace(one, cameras={**one.cameras, "02": behind}, train_cameras=("02",))
    frames_m = [wall(1, 1, 2), wall(1, 1, 3)]
    assert finest_pixel_m(one, frames_m, WALL) == pytest.approx(0.002)
    assert finest_pixel_m(one, frames_m[1:], WALL) == pytest.approx(0.003)
    assert finest_pixel_m(both, frames_m, WALL) == pytest.approx(0.003)
    both = dataclasses.replace(both, train_cameras=("02", "01"))
    assert finest_pixel_m(both, frames_m[::-1], WALL) == pytest.approx(0.002)


def test_the_width_is_the_median_over_the_surface() -> None:
    """A wall of 1 m² has a quarter of the texture, which is 2 m wide there, and a head of 0.04 m² as much, so that the
    texture is 0.4 m wide on it; a fold has no area in the texture."""
    chart = np.float32([[0, 0], [0.5, 0], [0.5, 0.5], [0, 0.5]])
    layout = UvLayout(np.concatenate([chart, chart + 0.5, 0 * chart]), np.concatenate([WALL, WALL + 4, WALL + 8]))
    vertices_m = np.concatenate([wall(1, 1, 0), wall(0.2, 0.2, 1), wall(0.2, 0.2, 2)])
    assert texture_width_m(vertices_m, layout.face_uvs, layout) == pytest.approx(2.0)
    assert texture_width_m(vertices_m, WALL + 4, UvLayout(layout.uvs, WALL + 4)) == pytest.approx(0.4)
