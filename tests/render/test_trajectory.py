import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hnerf.capture.formats.export import write_cameras
from hnerf.capture.lens import Lens
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from hnerf.render.trajectory import interpolate_cameras, orbit, read_camera_path

TARGET_M = np.array([1.0, 2, 1])


def camera_at(centre_m: tuple[float, float, float], yaw_deg: float = 0.0) -> Camera:
    """Return a level camera that looks along +y if the yaw is zero; Z is up."""
    level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    R = level @ Rotation.from_euler("z", -yaw_deg, degrees=True).as_matrix()
    K = np.array([[500.0, 0, 90], [0, 400, 50], [0, 0, 1]])
    return Camera("a", K, R, -R @ np.array(centre_m), 200, 101)


def plain(camera: Camera) -> dict[str, object]:
    size_px = [camera.width_px, camera.height_px]
    return {"K": camera.K.tolist(), "R": camera.R.tolist(), "t_m": camera.t_m.tolist(), "size_px": size_px}


def test_an_orbit_circles_its_target_at_the_given_radius_and_looks_at_it() -> None:
    found = orbit([camera_at((4, 2, 5))], TARGET_M, 4, "z", radius_m=2, height_m=0.5)
    expected_m = [[3, 2, 1.5], [1, 4, 1.5], [-1, 2, 1.5], [1, 0, 1.5]]  # from +x, where the first camera is, to +y
    np.testing.assert_allclose([c.centre_m for c in found], expected_m, atol=1e-9)
    for camera in found:
        (u, v), depth_m = camera.project(TARGET_M)
        np.testing.assert_allclose([u, v, depth_m], [99.5, 50, np.sqrt(4.25)])  # the middle of 200 x 101 pixels
        assert camera.project(TARGET_M + np.array([0, 0, 0.1]))[0][1] < v
        assert np.linalg.det(camera.R) == pytest.approx(1)


def test_an_orbit_is_by_default_as_far_and_high_as_the_cameras() -> None:
    first = orbit([camera_at((4, 2, 2)), camera_at((1, 3, 4))], TARGET_M, 3, "z")[0]
    np.testing.assert_allclose(first.centre_m, [3, 2, 3])  # 3 and 1 m away, 1 and 3 m up


def test_an_orbit_with_y_up_is_level_in_x_and_z() -> None:
    found = orbit([camera_at((1, 2, 4))], TARGET_M, 2, "y", height_m=1.0)
    np.testing.assert_allclose([c.centre_m for c in found], [[1, 3, 4], [1, 3, -2]], atol=1e-9)


@pytest.mark.parametrize(("radius_m", "height_m"), [(0.0, 1.0), (np.inf, 1.0), (1.0, np.nan)])
def test_an_orbit_that_is_no_circle_is_refused(radius_m: float, height_m: float) -> None:
    with pytest.raises(InputError, match="not a circle"):
        orbit([camera_at((4, 2, 5))], TARGET_M, 4, "z", radius_m, height_m)


def test_a_path_passes_through_its_cameras_and_interpolates_between_them() -> None:
    first, last = camera_at((0, 0, 1)), camera_at((2, 4, 3), yaw_deg=90)
    last = dataclasses.replace(last, K=last.K * [[2, 1, 1], [1, 1, 1], [1, 1, 1]])
    start, middle, end = interpolate_cameras([first, last], 3)
    for given, found in ((first, start), (last, end)):
        np.testing.assert_allclose(found.projection, given.projection, atol=1e-9)
    np.testing.assert_allclose(middle.centre_m, [1, 2, 2])
    np.testing.assert_allclose(middle.forward, [-np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-9)  # 45 degrees to the left
    assert middle.K[0, 0] == 750


def test_a_path_of_one_camera_stands_still() -> None:
    camera = camera_at((0, 0, 1))
    assert [found is camera for found in interpolate_cameras([camera], 3)] == [True] * 3


def test_a_path_is_read_from_json(tmp_path: Path) -> None:
    given = [camera_at((0, 0, 1)), camera_at((2, 4, 3), yaw_deg=30)]
    (tmp_path / "path.json").write_text(json.dumps([plain(camera) for camera in given]))
    for found, camera in zip(read_camera_path(tmp_path / "path.json", (1, 1)), given, strict=True):
        np.testing.assert_allclose(found.projection, camera.projection)
        assert (found.width_px, found.height_px) == (200, 101)


def test_a_path_is_read_from_a_folder_of_cameras_in_its_own_unit(tmp_path: Path) -> None:
    camera = camera_at((2, 4, 3))
    write_cameras(tmp_path, [Lens("a", camera.K, np.zeros(5), camera.R, 1000 * camera.t_m, None)], "easymocap")
    (tmp_path / "capture.toml").write_text("units = 'mm'")
    (found,) = read_camera_path(tmp_path, (200, 101))
    np.testing.assert_allclose(found.centre_m, [2, 4, 3])
    assert (found.width_px, found.height_px) == (200, 101)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "cameras of 0 image sizes"),
        ({"K": 1}, "not a list of cameras"),
        ([{"K": np.eye(3).tolist()}], "not a list of cameras"),
        ([plain(camera_at((0, 0, 1))) | {"R": np.ones((3, 3)).tolist()}], "R is not a rotation"),
        ([plain(camera_at((0, 0, 1))), plain(camera_at((0, 0, 1))) | {"size_px": [1, 1]}], "2 image sizes"),
    ],
)
def test_invalid_camera_paths_are_refused(content: object, message: str, tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"path.json.*{message}"):
        read_camera_path(tmp_path / "path.json", (1, 1))
