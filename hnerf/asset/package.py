"""The USD files of an avatar, laid out according to OpenUSD's guidelines for asset structure.

`avatar.usda` is the interface: variant sets, asset information, and payloads that lie in `avatar/`. `avatar_24.usda`
and `avatar_30.usda` show it at 24 and 30 frames a second, for importers that ignore a file's own rate; without the
resampled motions, there are none. `avatar_materialx.usda` adds MaterialX networks to the materials. `avatar.usdz` has
the prims and variants of `avatar.usda` in one layer, as ARKit requires. `avatar_cache.usdz` has the surface as points
at every frame, and `avatar_splats.usdc` has the splats, if they are wanted.

A second avatar, of the captured mesh, adds a variant set `topology`. All other variant sets are then inside its
variants, and the names of payloads and images start with the variant's name.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from pxr import Kind, Sdf, Tf, Usd, UsdGeom, UsdUtils, Vt

from hnerf.asset import usd
from hnerf.asset.materialx import author_network
from hnerf.asset.rigs import FULL
from hnerf.asset.splats import Splats
from hnerf.asset.staging import CAPTURED, StagedAvatar, box
from hnerf.body.descriptor import normals_of
from hnerf.capture.capture import write_image
from hnerf.geometry.camera import Camera

FIRST_TIME_S = time.mktime((1980, 1, 1, 0, 0, 0, 0, 0, -1))  # the earliest that ZIP can store, which has local times
INTERFACE, PAYLOADS = "avatar.usda", "avatar"

Variant = tuple[str, str]  # the variant set and the name in it
Avatars = dict[str, StagedAvatar]  # by topology; if there is only one, by "" and without that variant set


@dataclass(frozen=True)
class AssetInfo:
    """The package's metadata. name: of the subject; version, licence: as given by the user; capture: the digest of the
    recording; settings: those of the asset, by name; figures: how close it is to its field, as in `report.json`."""

    name: str
    version: str
    licence: str
    capture: str
    settings: Mapping[str, Any]
    figures: Mapping[str, Any]


@dataclass(frozen=True)
class Part:
    """A part of the package. name: of its payload; author: defines its prims; fps: the rate of its layer's time codes;
    variant: the variant that it defines, if any; topology: the variant that contains this one, if any."""

    name: str
    author: Callable[[Usd.Stage], None]
    fps: float
    variant: Variant | None
    topology: Variant | None


def write_package(out: Path, avatars: Avatars, cameras: Sequence[Camera], fps: float, info: AssetInfo) -> None:
    """Write `avatar.usda`, the same at each of the avatar's rates (`avatar_24.usda`) and with MaterialX, and the folder
    `avatar/` into `out`."""
    folder = out / PAYLOADS
    folder.mkdir()
    _write_images(folder, avatars)
    parts, networks = list(_parts(avatars, cameras, fps)), list(_networks(avatars, fps))
    for part in (*parts, *networks):
        layer = Usd.Stage.CreateNew(str(folder / f"{part.name}.usdc"))
        _set_units(layer, part.fps)
        layer.SetDefaultPrim(layer.OverridePrim(usd.ROOT))
        part.author(layer)
        _save(layer)
    _write_interface(out / INTERFACE, parts, avatars, fps, info, CAPTURED)
    _write_interface(out / "avatar_materialx.usda", parts + networks, avatars, fps, info, CAPTURED)
    for rate in next(iter(avatars.values())).rates:
        _write_interface(out / f"avatar_{rate}.usda", parts, avatars, rate, info, f"{CAPTURED}_{rate}")


def write_usdz(path: Path, avatars: Avatars, cameras: Sequence[Camera], fps: float, info: AssetInfo) -> None:
    """Write `avatar.usdz`: the same prims and variants as the package in a single layer, and the texture."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        layer = Path(folder) / "avatar.usdc"
        stage = _new_stage(layer, path.name, avatars, _time_range(avatars, CAPTURED, fps), fps, info)
        _describe(stage, info)
        for part in _parts(avatars, cameras, fps):
            with _in_variant(stage, part.topology), _in_variant(stage, part.variant):
                part.author(stage)
        _select(stage, avatars, CAPTURED)
        _package(stage, avatars, path)


def write_cache(path: Path, avatar: StagedAvatar, cameras: Sequence[Camera], fps: float, info: AssetInfo) -> None:
    """Write `avatar_cache.usdz`: the surface as world-space points at every frame, for programs without skinning."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        layer = Path(folder) / "avatar_cache.usdc"
        stage = _new_stage(layer, path.name, {"": avatar}, avatar.frames, fps, info)
        usd.author_cameras(stage, cameras, avatar.stage_from_world)
        mesh = usd.define_mesh(stage, usd.ROOT.AppendChild("Surface"), avatar, level=0)
        usd.author_look(stage, "captured", [mesh.GetPath()], avatar)
        points, extents, normals = mesh.CreatePointsAttr(), mesh.CreateExtentAttr(), mesh.CreateNormalsAttr()
        for frame, posed in zip(avatar.frames, avatar.points_m, strict=True):
            points.Set(usd.vec3f(posed), float(frame))
            extents.Set(usd.extent(posed), float(frame))
            normals.Set(usd.vec3f(normals_of(posed, avatar.faces)), float(frame))
        _package(stage, {"": avatar}, path)


def write_splats(path: Path, avatar: StagedAvatar, splats: Splats, fps: float, info: AssetInfo) -> None:
    """Write `avatar_splats.usdc`: Gaussian splats on the surface at every frame."""
    stage = _new_stage(path, path.name, {"": avatar}, avatar.frames, fps, info)
    usd.author_splats(stage, avatar, splats)
    _save(stage)


def _prefix(topology: str) -> str:
    """Return the prefix of the names of payloads and images."""
    return f"{topology}_" if topology else ""


def _variant(topology: str) -> Variant | None:
    return ("topology", topology) if topology else None


def _parts(avatars: Avatars, cameras: Sequence[Camera], fps: float) -> Iterator[Part]:
    """Yield the parts of the package, inside the variants of `topology` if there are several. Earlier parts override
    later ones: shapes replace the extents of motions."""
    for topology, avatar in avatars.items():
        prefix, outer = _prefix(topology), _variant(topology)
        for name, physique in {CAPTURED: None, **{name: name for name in avatar.physiques_m}}.items():
            author = partial(usd.author_shape, avatar=avatar, physique=physique)
            yield Part(f"{prefix}shape_{name}", author, fps, ("shape", name), outer)
        for level in range(len(avatar.levels)):
            author = partial(usd.author_geometry, avatar=avatar, level=level)
            yield Part(f"{prefix}geometry_lod{level}", author, fps, ("lod", f"lod{level}"), outer)
        meshes = [usd.surface_path(level) for level in range(len(avatar.levels))]
        for name in avatar.looks:
            author = partial(usd.author_look, name=name, meshes=meshes, avatar=avatar, prefix=prefix)
            yield Part(f"{prefix}look_{name}", author, fps, ("look", name), outer)
        author = partial(usd.author_cameras, cameras=cameras, stage_from_world=avatar.stage_from_world)
        yield Part(f"{prefix}cameras", author, fps, None, outer)
        for name, rig in avatar.rigs.items():
            author = partial(usd.author_rig, name=name, rig=rig, avatar=avatar)
            yield Part(f"{prefix}rig_{name}", author, fps, ("rig", name), outer)
        for name, motion in avatar.rigs[FULL].motions.items():
            author = partial(usd.author_motion, name=name, avatar=avatar)
            yield Part(f"{prefix}motion_{name}", author, motion.fps, ("motion", name), outer)


def _networks(avatars: Avatars, fps: float) -> Iterator[Part]:
    """Yield the MaterialX networks of all looks."""
    for topology, avatar in avatars.items():
        prefix = _prefix(topology)
        for name in avatar.looks:
            author = partial(author_network, name=name, avatar=avatar, prefix=prefix)
            yield Part(f"{prefix}materialx_{name}", author, fps, ("look", name), _variant(topology))


@contextmanager
def _in_variant(stage: Usd.Stage, variant: Variant | None) -> Iterator[None]:
    """Author what follows inside a variant of the root prim, if there is one."""
    if variant is None:
        yield
        return
    variants = stage.GetDefaultPrim().GetVariantSets().AddVariantSet(variant[0])
    variants.AddVariant(variant[1])
    variants.SetVariantSelection(variant[1])
    with variants.GetVariantEditContext():
        yield


def _select(stage: Usd.Stage, avatars: Avatars, motion: str) -> None:
    """Select the default variants: the first topology, and in each one the captured motion of the whole mesh."""
    default = {"shape": CAPTURED, "lod": "lod0", "look": "captured", "rig": FULL, "motion": motion}
    for topology in reversed(avatars):
        with _in_variant(stage, _variant(topology)):
            for name, variant in default.items():
                stage.GetDefaultPrim().GetVariantSets().SetSelection(name, variant)


def _write_interface(file: Path, parts: list[Part], avatars: Avatars, fps: float, info: AssetInfo, motion: str) -> None:
    """Write an interface layer with a rate of its time codes and with that motion selected. It refers to the payloads
    directly: time codes that are scaled twice are not whole, and importers that hold samples would be a frame late."""
    stage = _new_stage(file, file.name, avatars, _time_range(avatars, motion, fps), fps, info)
    _describe(stage, info)
    for part in parts:
        path = f"./{PAYLOADS}/{part.name}.usdc"
        with _in_variant(stage, part.topology), _in_variant(stage, part.variant):
            stage.GetDefaultPrim().GetPayloads().AddPayload(path)
    _select(stage, avatars, motion)
    _save(stage)


def _time_range(avatars: Avatars, selected: str, fps: float) -> np.ndarray:
    """Return the first and the last time code of a captured motion, (2,), extended to the end of further motions that
    last longer, since a stage has one range for all of its variants."""
    motions = next(iter(avatars.values())).rigs[FULL].motions
    ends = [m.codes[-1] / m.fps * fps for name, m in motions.items() if not name.startswith(CAPTURED)]
    first, last = motions[selected].codes[[0, -1]]
    return np.array([first, max([last, *(np.ceil(end - 1e-6) for end in ends)])])


def _new_stage(file: Path, name: str, avatars: Avatars, codes: np.ndarray, fps: float, info: AssetInfo) -> Usd.Stage:
    """Return a stage from the first to the last of time codes, with the root prim and its metadata. name: of the file
    that the user opens, in which `file` may be packed."""
    stage = Usd.Stage.CreateNew(str(file))
    _set_units(stage, fps)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    root = UsdGeom.Xform.Define(stage, usd.ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    model = Usd.ModelAPI(root)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(info.name)
    model.SetAssetIdentifier(Sdf.AssetPath(f"./{name}"))
    model.SetAssetVersion(info.version)
    for key, value in (("captureDigest", info.capture), ("licence", info.licence)):
        root.SetAssetInfoByKey(key, value)
    UsdGeom.ModelAPI.Apply(root).SetExtentsHint(usd.extent(np.concatenate([*map(_everywhere, avatars.values())])))
    return stage


def _describe(stage: Usd.Stage, info: AssetInfo) -> None:
    """Add how the asset was made, and how close it is to its field, to the root prim's metadata."""
    settings = {name: Vt.IntArray(v) if isinstance(v, tuple) else v for name, v in info.settings.items()}
    stage.GetDefaultPrim().SetAssetInfoByKey("settings", settings)
    stage.GetDefaultPrim().SetAssetInfoByKey("figures", dict(info.figures))


def _set_units(stage: Usd.Stage, fps: float) -> None:
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)


def _everywhere(avatar: StagedAvatar) -> np.ndarray:
    """Return the corners (n, 3) of boxes around the surface at rest, in all motions and physiques, and in the cache."""
    corners = [box(avatar.rest_points_m), box(avatar.points_m.reshape(-1, 3))]
    corners += [boxes.reshape(-1, 3) for boxes in avatar.extents_m.values()]
    return np.concatenate([*corners, *(usd.physique_box(avatar, name) for name in avatar.physiques_m)])


def _save(stage: Usd.Stage) -> None:
    """Write a stage's file. Raises OSError if USD cannot."""
    try:
        stage.GetRootLayer().Save()
    except Tf.ErrorException as error:
        raise OSError(f"{stage.GetRootLayer().realPath}: cannot be written; is the disk full?") from error


def _package(stage: Usd.Stage, avatars: Avatars, path: Path) -> None:
    layer = Path(stage.GetRootLayer().realPath)
    _save(stage)
    _write_images(layer.parent, avatars)
    for file in layer.parent.iterdir():  # the package keeps their times; the same avatar is to give the same bytes
        os.utime(file, (FIRST_TIME_S, FIRST_TIME_S))
    if not UsdUtils.CreateNewARKitUsdzPackage(str(layer), str(path)) or not is_zipfile(path):
        raise OSError(f"{path}: USD could not write the package; is the disk full?")


def _write_images(folder: Path, avatars: Avatars) -> None:
    for topology, avatar in avatars.items():
        prefix = _prefix(topology)
        for look, texture in avatar.looks.items():
            write_image(folder / f"{prefix}{usd.TEXTURE_NAMES[look]}", texture)
        if avatar.albedo is not None:
            write_image(folder / f"{prefix}{usd.LIGHT_NAME}", avatar.albedo.dome[0])
        if avatar.normal_map is not None:
            write_image(folder / f"{prefix}{usd.NORMAL_MAP_NAME}", avatar.normal_map)
