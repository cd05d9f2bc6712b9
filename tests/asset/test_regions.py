import dataclasses

import numpy as np
import pytest
import trimesh

from hnerf.asset.correctives import as_they_are
from hnerf.asset.regions import (
    LIMIT_MM,
    _summary,
    chosen_topology,
    crossing_findings,
    findings,
    region_of,
    surface_distances_mm,
)
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.topologies import AssetMesh
from tests.asset.figure import column_rig, twice, upright_column


@pytest.mark.parametrize(
    ("joint", "region"),
    [("neck01", "head"), ("eye.L", "head"), ("clavicle.R", "torso"), ("spine03", "torso"), ("root", "torso"),
     ("lowerarm02.L", "arms"), ("wrist.R", "hands"), ("hand.L", "hands"), ("finger2-3.L", "hands"),
     ("metacarpal1.L", "hands"),
     ("upperleg01.L", "legs"), ("foot.R", "feet"), ("toe5-3.R", "feet"), ("pelvis.L", "torso")],
)  # fmt: skip
def test_regions_by_joint(joint: str, region: str) -> None:
    assert region_of(joint) == region


def test_distances_from_the_fields_surface_to_each_mesh() -> None:
    """The field's surface has a radius of 17 cm, the meshes 15 and 16.5 cm. Their sides are flat, so distances are a
    little longer than between circles."""
    meshes = {}
    for name, radius_m in (("registered", 0.15), ("captured", 0.165)):
        surface = upright_column(radius_m, -0.02, 1.62)
        meshes[name] = AssetMesh(clothed_rig(column_rig(), surface), as_they_are, len(surface.faces), None)
    found = surface_distances_mm(upright_column(0.17, -0.02, 1.62), meshes)
    assert found["registered"]["all"]["p95"] == pytest.approx(20, abs=0.3)
    assert found["captured"]["all"]["p95"] == pytest.approx(5, abs=0.3)
    assert set(found["registered"]) == {"all", "torso"}
    assert findings("registered", found["captured"]) == [] == findings("captured", found["registered"])
    (line,) = findings("registered", found["registered"])
    assert line.startswith("torso: ") and "20 mm" in line and "topology=captured" in line


def test_distances_are_assigned_to_regions_by_skinning_joints() -> None:
    """The head, above 0.8 m, is 30 mm away from the field's surface, and everything below 20 mm."""
    mesh, field = upright_column(0.15, -0.02, 1.62), upright_column(0.17, -0.02, 1.62)
    field.vertices *= np.where(field.vertices[:, 2:] > 0.8, (18 / 17, 18 / 17, 1), 1)
    rig = clothed_rig(dataclasses.replace(column_rig(), joint_names=("root", "head")), mesh)
    found = surface_distances_mm(field, {"registered": AssetMesh(rig, as_they_are, len(mesh.faces), None)})
    assert set(found["registered"]) == {"all", "torso", "head"}
    assert found["registered"]["head"]["p95"] == pytest.approx(30, abs=0.5)
    assert found["registered"]["torso"]["p95"] == pytest.approx(20, abs=0.5)


def test_a_region_exactly_at_the_limit_is_not_reported() -> None:
    at_limit = {"all": {"mean": 50, "p95": 99}, "legs": {"mean": 1.0, "p95": LIMIT_MM}}
    assert findings("auto", at_limit) == [] and chosen_topology("auto", at_limit) == "registered"


@pytest.mark.parametrize(
    ("wanted", "chosen"),
    [("auto", "captured"), ("registered", "registered"), ("captured", "captured"), ("both", "registered")],
)
def test_only_auto_falls_back_to_the_captured_mesh(wanted: str, chosen: str) -> None:
    assert chosen_topology(wanted, {"legs": {"mean": 1.0, "p95": LIMIT_MM + 0.1}}) == chosen


@pytest.mark.parametrize(("joint", "found"), [("neck01", True), ("foot.L", False)])
def test_faces_of_the_head_that_cross_are_reported(joint: str, found: bool) -> None:
    """Two boxes overlap by half a millimetre: 10 of their 24 faces cross faces of the other."""
    boxes = twice(trimesh.creation.box(extents=(0.02, 0.02, 0.02)), (0.0195, 0.001, 0.001))
    rig = clothed_rig(dataclasses.replace(column_rig(), joint_names=(joint, "toe1-1.L")), boxes)
    lines = crossing_findings(AssetMesh(rig, as_they_are, len(boxes.faces), None))
    assert [line.startswith("head: 10 faces cross others") for line in lines] == [True] * found


def test_mean_and_95th_percentile() -> None:
    assert _summary(np.append(np.arange(100.0), 1050)) == {"mean": pytest.approx(6000 / 101), "p95": 95}


def test_hands_and_feet_alone_do_not_exchange_the_mesh() -> None:
    over = {"mean": 1.0, "p95": LIMIT_MM + 0.1}
    assert chosen_topology("auto", {"hands": over, "feet": over}) == "registered"
    assert chosen_topology("auto", {"hands": over, "head": over}) == "captured"
    (line,) = findings("auto", {"hands": over})
    assert line.endswith("asset.topology=captured follows them")
