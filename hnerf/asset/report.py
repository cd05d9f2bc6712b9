"""The report of the asset: one self-contained HTML file beside it, which links to the viewer."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from hnerf.asset.pictures import texture_picture, textured, turntable_cameras, uv_picture, wireframe
from hnerf.asset.staging import StagedAvatar
from hnerf.evaluation.galleries import GalleryPicture
from hnerf.evaluation.pictures import clay, data_uri
from hnerf.evaluation.report import report_environment
from hnerf.geometry.mesh_queries import Surface

TEMPLATES = Path(__file__).parent / "page"
TURNS = 8  # views of the turntable
SQUARE_PX = 640  # of the texture and its layout


def write_report(
    path: Path, name: str, avatar: StagedAvatar, frame: int, world_from_body: np.ndarray, figures: dict[str, Any]
) -> None:
    """Write the page of an avatar called `name`, shown in the pose of a frame. world_from_body (4, 4): the body's place
    in it, Z up and facing -Y; figures: what `report.json` holds."""
    facing = avatar.stage_from_world @ -world_from_body[:3, 1]
    points_m = avatar.points_m[list(avatar.frames).index(frame)].astype(np.float64)
    surface = Surface(trimesh.Trimesh(points_m, avatar.faces, process=False))
    cameras = turntable_cameras(points_m, facing, TURNS)
    front, back = cameras[0], cameras[TURNS // 2]
    page = report_environment(TEMPLATES).get_template("asset.html")
    path.write_text(
        page.render(
            name=name,
            frame=frame,
            has_viewer=(path.parent / "viewer.html").exists(),
            turntable=[
                _picture(f"{round(360 * k / TURNS)}°", textured(surface, avatar, camera))
                for k, camera in enumerate(cameras)
            ],
            surface=[
                _picture("Clay, front", clay(surface, front)),
                _picture("Clay, back", clay(surface, back)),
                _picture("Wireframe, front", wireframe(surface, front)),
                _picture("Wireframe, back", wireframe(surface, back)),
            ],
            texture=[
                _picture("Texture", texture_picture(avatar, SQUARE_PX)),
                _picture("Layout", uv_picture(avatar, SQUARE_PX)),
            ],
            figures=figures,
        ),
        encoding="utf-8",
    )


def _picture(caption: str, picture: np.ndarray) -> GalleryPicture:
    return GalleryPicture(caption, data_uri(picture))
