import shutil
from pathlib import Path

import pytest
from pxr import Sdf, Usd, UsdShade

from hnerf.asset.validation import data_defects, validate_package
from hnerf.errors import InvalidAsset


def network(stage: Usd.Stage, look: str, topology: str = "") -> dict[str, object]:
    """Return the MaterialX nodes of the selected look's material, as dictionaries of their inputs and node definition:
    values, and for connected inputs the name of the other node."""
    if topology:
        stage.GetDefaultPrim().GetVariantSet("topology").SetVariantSelection(topology)
    stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection(look)
    mesh = stage.GetPrimAtPath("/Avatar/Body/Surface")
    material = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]
    assert material.ComputeSurfaceSource()[0].GetShaderId() == "UsdPreviewSurface"
    assert material.ComputeSurfaceSource("mtlx")[0].GetPath().name == "MaterialXSurface"
    nodes: dict[str, object] = {}
    for prim in material.GetPrim().GetChildren():
        if prim.GetName().startswith("MaterialX"):
            nodes[prim.GetName().removeprefix("MaterialX")] = inputs(UsdShade.Shader(prim))
    return nodes


def inputs(shader: UsdShade.Shader) -> dict[str, object]:
    found: dict[str, object] = {"id": shader.GetShaderId()}
    for given in shader.GetInputs():
        sources = given.GetConnectedSources()[0]
        value = given.Get()
        if sources:
            assert sources[0].sourceName == "out"
            value = sources[0].source.GetPath().name.removeprefix("MaterialX")
        elif isinstance(value, Sdf.AssetPath):
            value = (Path(value.resolvedPath).name, given.GetAttr().GetColorSpace())
        found[given.GetBaseName()] = value
    return found


LOOKUP = {"texcoord": "TextureCoordinates", "uaddressmode": "clamp", "vaddressmode": "clamp"}
COORDINATES = {"id": "ND_geompropvalue_vector2", "geomprop": "st"}
SURFACE = {"id": "ND_UsdPreviewSurface_surfaceshader", "roughness": 1, "metallic": 0, "ior": 1}


def test_the_captured_look_emits_its_texture(package: Path) -> None:
    nodes = network(Usd.Stage.Open(str(package / "avatar_materialx.usda")), "captured")
    assert nodes == {
        "TextureCoordinates": COORDINATES,
        "Texture": {"id": "ND_image_color3", "file": ("texture.png", "srgb_texture"), **LOOKUP},
        "Surface": {**SURFACE, "diffuseColor": (0, 0, 0), "emissiveColor": "Texture"},
    }


@pytest.mark.parametrize("topology", ["", "registered", "captured"])
def test_the_albedo_is_matte_with_the_normal_map(topology: str, package: Path, both: Path) -> None:
    """The images of both topologies are beside each other. The normal map's values from 0 to 1 become components from
    -1 to 1, as the preview surface's node takes them."""
    stage = Usd.Stage.Open(str((both if topology else package) / "avatar_materialx.usda"))
    prefix = f"{topology}_" if topology else ""
    assert network(stage, "albedo", topology) == {
        "TextureCoordinates": COORDINATES,
        "Texture": {"id": "ND_image_color3", "file": (f"{prefix}albedo.png", "srgb_texture"), **LOOKUP},
        "NormalMap": {"id": "ND_image_vector3", "file": (f"{prefix}normal_map.png", ""), **LOOKUP},
        "NormalMapScale": {"id": "ND_multiply_vector3FA", "in1": "NormalMap", "in2": 2},
        "NormalMapBias": {"id": "ND_subtract_vector3FA", "in1": "NormalMapScale", "in2": 1},
        "Surface": {**SURFACE, "diffuseColor": "Texture", "normal": "NormalMapBias"},
    }


@pytest.mark.parametrize("name", ["avatar.usda", "avatar_24.usda", "avatar.usdz", "avatar_cache.usdz"])
def test_other_files_have_no_network_and_no_note(name: str, package: Path) -> None:
    stage = Usd.Stage.Open(str(package / name))
    for look in ("captured", "albedo"):
        stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection(look)
        (material,) = (UsdShade.Material(prim) for prim in stage.Traverse() if prim.IsA(UsdShade.Material))
        assert not material.GetSurfaceOutput("mtlx")
    assert validate_package(package / name)["infos"] == []


def test_nodes_that_the_build_of_usd_does_not_know_are_noted(package: Path, both: Path) -> None:
    """One topology has three nodes in the captured look and six in the albedo."""
    for folder, variants in ((package, 20), (both, 20 + 12)):
        report = validate_package(folder / "avatar_materialx.usda")
        assert (report["variants"], report["warnings"]) == (variants, [])
        assert len(report["infos"]) == 3 + 6 and all("'ND_" in note for note in report["infos"])


@pytest.mark.parametrize(
    ("identifier", "message"),
    [("ND_image_colour3", "'ND_image_colour3' specified on shader prim .* not found"), ("UsdUVTextur", "not found")],
)
def test_a_node_that_nobody_knows_is_an_error(identifier: str, message: str, package: Path, tmp_path: Path) -> None:
    shutil.copytree(package, tmp_path / "copy")
    look = Usd.Stage.Open(str(tmp_path / "copy/avatar/materialx_captured.usdc"))
    UsdShade.Shader(look.GetPrimAtPath("/Avatar/Materials/Captured/MaterialXTexture")).SetShaderId(identifier)
    look.GetRootLayer().Save()
    with pytest.raises(InvalidAsset, match=message):
        validate_package(tmp_path / "copy/avatar_materialx.usda")


def test_inputs_and_outputs_that_a_node_lacks_are_reported(package: Path) -> None:
    stage = Usd.Stage.Open(str(package / "avatar_materialx.usda"))
    stage.SetEditTarget(stage.GetSessionLayer())
    assert data_defects(stage) == []
    wrong = UsdShade.Shader.Define(stage, "/Avatar/Materials/Captured/Wrong")
    wrong.CreateIdAttr("ND_image_color3")
    wrong.CreateInput("uaddressmode", Sdf.ValueTypeNames.String)
    wrong.CreateInput("file", Sdf.ValueTypeNames.String)
    wrong.CreateInput("st", Sdf.ValueTypeNames.Float2)
    wrong.CreateOutput("rgb", Sdf.ValueTypeNames.Color3f)
    assert data_defects(stage) == [
        f"/Avatar/Materials/Captured/Wrong.{end}: ND_image_color3 has nothing of this name and type"
        for end in ("inputs:file", "inputs:st", "outputs:rgb")
    ]
