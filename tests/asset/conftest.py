import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.asset.albedo import Albedo
from hnerf.asset.correctives import correctives_of
from hnerf.asset.light import Light
from hnerf.asset.package import write_package, write_usdz
from hnerf.asset.staging import StagedAvatar, stage_avatar
from hnerf.asset.texture import unwrap
from tests.asset.figure import (
    FRAMES,
    INFO,
    bending_body,
    dressed,
    posed_with_displacements,
    side_camera,
    upright_column,
    write_all,
)


@pytest.fixture(scope="session")
def staged() -> StagedAvatar:
    """Return a staged avatar: clothes around the bending column, with levels of 816 and 400 faces, two correctives of
    random noise, an expression that moves its top (`frown`), a physique (`stout`), textures and a normal map of noise,
    and light from above."""
    clothes = upright_column(0.18, -0.05, 1.65)
    layout, clothed = unwrap(clothes.vertices, clothes.faces, 64), dressed(bending_body(), clothes)
    rng = np.random.default_rng(0)
    shapes_m = rng.normal(scale=0.01, size=(2, len(clothes.vertices), 3))
    moved_m = np.einsum("nk,kvd->nvd", rng.normal(size=(len(FRAMES), 2)), shapes_m).astype(np.float32)
    texture = rng.integers(0, 255, (64, 64, 3), np.uint8)
    surfaces_m = posed_with_displacements(clothed, moved_m)
    normals = rng.integers(100, 156, (32, 32, 3), np.uint8)
    shapes = correctives_of(moved_m, 2)
    albedo = Albedo(rng.integers(0, 255, (64, 64, 3), np.uint8), Light(np.array([0.7, 0, 0.26, 0, 0, 0, 0, 0, 0]), 9.0))
    top = clothes.vertices[:, 2] > 1.6
    frown_m = np.where(top[:, None], (0.01, 0.02, 0.03), 0).astype(np.float32)  # left, back, up
    return stage_avatar(
        clothed,
        surfaces_m,
        shapes,
        layout,
        texture,
        "z",
        10.0,
        albedo=albedo,
        normal_map=normals,
        level_faces=[400],
        expressions_m={"frown": frown_m},
        physiques_m={"stout": (0.3 * clothes.vertices * (1, 1, 0)).astype(np.float32)},
    )


@pytest.fixture(scope="session")
def captured(staged: StagedAvatar) -> StagedAvatar:
    """Return the staged avatar with clothes a fifth wider, bounding boxes twice as large, other colours and another
    light, only at full detail and without expression and physique."""
    assert staged.albedo is not None and staged.normal_map is not None
    return dataclasses.replace(
        staged,
        rest_points_m=staged.rest_points_m * (1.2, 1, 1.2),
        extents_m={name: 2 * boxes for name, boxes in staged.extents_m.items()},
        levels=staged.levels[:1],
        expressions_m={},
        physiques_m={},
        texture=255 - staged.texture,
        normal_map=255 - staged.normal_map,
        albedo=Albedo(255 - staged.albedo.texture, Light(np.array([0.7, 0, 0.1, 0, 0, 0, 0, 0, 0]), 9.0)),
    )


@pytest.fixture(scope="session")
def package(staged: StagedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files of `write_all`, for tests that do not modify it."""
    out = tmp_path_factory.mktemp("package")
    write_all(out, staged)
    return out


@pytest.fixture(scope="session")
def both(staged: StagedAvatar, captured: StagedAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the package and `avatar.usdz` of two topologies, for tests that do not modify it."""
    out = tmp_path_factory.mktemp("both")
    write_package(out, {"registered": staged, "captured": captured}, [side_camera()], 10.0, INFO)
    write_usdz(out / "avatar.usdz", {"registered": staged, "captured": captured}, [side_camera()], 10.0, INFO)
    return out


@pytest.fixture
def small_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make reports with few and small images, and without a viewer, because the capture has no pixels."""
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path / "nothing"))
    monkeypatch.setattr("hnerf.asset.report.STILLS", 2)
    monkeypatch.setattr("hnerf.asset.report.TURNS", 2)
    monkeypatch.setattr("hnerf.evaluation.pictures.PICTURE_PX", (30, 40))
