"""The report of the asset."""

from typing import Any, NotRequired

from typing_extensions import TypedDict


class Surface(TypedDict):
    """The field's surface in the rest pose."""

    faces: int
    watertight: bool
    volume_l: float


class MeshFigures(TypedDict):
    """The asset's mesh. crossing_faces: of its skin, at rest."""

    topology: str
    vertices: int
    faces: int
    watertight: bool
    crossing_faces: int
    height_m: float


class LevelFigures(TypedDict):
    """A level of detail, and the distance of its surface from that of lod0, at rest."""

    vertices: int
    triangles: int
    to_lod0_mean_mm: NotRequired[float]
    to_lod0_p99_mm: NotRequired[float]


class BeyondSkinning(TypedDict):
    """Root mean square distance of the frames' surfaces from the skinned surface, in mm."""

    skinned: float
    with_correctives: float


class Distance(TypedDict):
    """Distance of a mesh from the field's surface, in mm."""

    mean: float
    p95: float


class Light(TypedDict):
    """The estimated light. coefficients (9,): of spherical harmonics up to order 2; normals_turned_deg: root mean
    square angle by which the normals of single points turned."""

    coefficients: list[float]
    normals_turned_deg: float


class Moved(TypedDict):
    """How far points of the captured surfaces move from where the full rig has them, each in its worst frame."""

    moved_p99_mm: float
    moved_max_mm: float


class RigFigures(Moved):
    """A rig. influences: joints that move a point, at most."""

    joints: int
    influences: int


class SplatFigures(Moved):
    """Gaussian splats. sigma_mm: along the surface."""

    count: int
    sigma_mm: float


class MotionFigures(TypedDict):
    """A motion: frames a second, and number of poses."""

    fps: float
    poses: int


class Validation(TypedDict):
    """Findings of OpenUSD's validators, over a number of variants."""

    validators: int
    variants: int
    warnings: list[str]
    infos: list[str]


class MeshAssetFigures(TypedDict):
    """Figures in which the assets of two meshes differ. source_pixel_mm: the finest pixel of the photographs;
    filled_share: of texels that no photograph shows; against_field: scores of the field and of the asset's looks."""

    mesh: MeshFigures
    levels: dict[str, LevelFigures]
    texture_px: int
    texel_mm: float
    source_pixel_mm: float | None
    filled_share: float
    beyond_skinning_mm: BeyondSkinning
    against_field: dict[str, Any]


class CapturedAsset(MeshAssetFigures):
    """The captured mesh, where the asset has both. seconds: duration of each part."""

    seconds: dict[str, float]


class AssetReport(MeshAssetFigures):
    """report.json of the asset. to_surface_mm: by mesh and region of the body; findings: where a mesh is far from the
    surface; crossing_share: of faces that cross others, by extreme pose and expression; bytes: by file; seconds:
    duration of each part."""

    surface: Surface
    to_surface_mm: dict[str, dict[str, Distance]]
    normal_map_px: int
    light: Light | None
    expressions: list[str]
    physiques: list[str]
    joints: int
    rigs: dict[str, RigFigures]
    motions: dict[str, MotionFigures]
    frames: int
    cameras: int
    findings: list[str]
    crossing_share: dict[str, float]
    viewer: str
    bytes: dict[str, int]
    seconds: dict[str, float]
    validation: dict[str, Validation]
    captured: NotRequired[CapturedAsset]
    splats: NotRequired[SplatFigures]
