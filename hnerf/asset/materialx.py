"""MaterialX networks of materials, beside their preview surfaces.

OpenUSD's wheels are built without MaterialX, and their validators report its nodes as unknown. So `NODES` repeats the
inputs and outputs that are used here, from the standard library of MaterialX; 1.38 and 1.39 have the same.
"""

from pxr import Gf, Sdf, Usd, UsdShade, UsdValidation

from hnerf.asset.staging import StagedAvatar
from hnerf.asset.usd import MATTE, NORMAL_MAP_NAME, TEXTURE_NAMES, look_path

UNKNOWN = "MissingShaderIdInRegistry"

_T = Sdf.ValueTypeNames
_IMAGE = {"file": _T.Asset, "texcoord": _T.Float2, "uaddressmode": _T.String, "vaddressmode": _T.String}
_ARITHMETIC = {"in1": _T.Float3, "in2": _T.Float, "out": _T.Float3}
NODES = {
    "ND_UsdPreviewSurface_surfaceshader": {
        **{"diffuseColor": _T.Color3f, "emissiveColor": _T.Color3f, "normal": _T.Float3, "out": _T.Token},
        **dict.fromkeys(MATTE, _T.Float),
    },
    "ND_geompropvalue_vector2": {"geomprop": _T.String, "out": _T.Float2},
    "ND_image_color3": {**_IMAGE, "out": _T.Color3f},
    "ND_image_vector3": {**_IMAGE, "out": _T.Float3},
    "ND_multiply_vector3FA": _ARITHMETIC,
    "ND_subtract_vector3FA": _ARITHMETIC,
}  # types of inputs and outputs, by node definition


def author_network(stage: Usd.Stage, name: str, avatar: StagedAvatar, prefix: str = "") -> None:
    """Add a MaterialX network to the material of a look. The captured texture is emitted, since it contains the
    recording's light; the albedo is as matte as its preview surface, with the normal map. prefix: of the names of
    images."""
    material = UsdShade.Material(stage.OverridePrim(look_path(name)))

    def node(prim: str, identifier: str, **inputs: object) -> UsdShade.Output:
        shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild(f"MaterialX{prim}"))
        shader.CreateIdAttr(identifier)
        for key, value in inputs.items():
            given = shader.CreateInput(key, NODES[identifier][key])
            given.ConnectToSource(value) if isinstance(value, UsdShade.Output) else given.Set(value)
        return shader.CreateOutput("out", NODES[identifier]["out"])

    coordinates = node("TextureCoordinates", "ND_geompropvalue_vector2", geomprop="st")
    lookup = {"texcoord": coordinates, "uaddressmode": "clamp", "vaddressmode": "clamp"}
    texture = node("Texture", "ND_image_color3", file=f"./{prefix}{TEXTURE_NAMES[name]}", **lookup)
    UsdShade.Shader(texture.GetPrim()).GetInput("file").GetAttr().SetColorSpace("srgb_texture")
    inputs: dict[str, object] = {"diffuseColor": texture}
    if name == "captured":
        inputs = {"diffuseColor": Gf.Vec3f(0), "emissiveColor": texture}
    elif avatar.normal_map is not None:
        values = node("NormalMap", "ND_image_vector3", file=f"./{prefix}{NORMAL_MAP_NAME}", **lookup)
        doubled = node("NormalMapScale", "ND_multiply_vector3FA", in1=values, in2=2.0)
        inputs["normal"] = node("NormalMapBias", "ND_subtract_vector3FA", in1=doubled, in2=1.0)
    surface = node("Surface", "ND_UsdPreviewSurface_surfaceshader", **MATTE, **inputs)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(surface)


def is_unknown_node(finding: UsdValidation.ValidationError) -> bool:
    """Return whether OpenUSD's validators report only that their build does not know a node of `NODES`."""
    return finding.GetName() == UNKNOWN and finding.GetSites()[0].GetProperty().Get() in NODES


def node_defects(shader: UsdShade.Shader) -> list[str]:
    """Return one line for each input or output of a MaterialX node that its definition lacks or gives another type."""
    types = NODES.get(shader.GetShaderId() or "")
    if types is None:
        return []
    ends = [*shader.GetInputs(), *shader.GetOutputs()]
    wrong = [end.GetAttr().GetPath() for end in ends if types.get(end.GetBaseName()) != end.GetTypeName()]
    return [f"{path}: {shader.GetShaderId()} has nothing of this name and type" for path in wrong]
