"""The bending column's glTF file, as passed to the viewer."""

from hnerf.asset.compact_glb import as_glb, read_glb


def with_joints_in_second_set(glb: bytes) -> bytes:
    """Return the file with four zero-weight influences inserted before those of each vertex."""
    document, binary = read_glb(glb)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    for name in ("JOINTS", "WEIGHTS"):
        attributes[f"{name}_1"] = attributes[f"{name}_0"]
        accessor = document["accessors"][attributes[f"{name}_1"]]
        attributes[f"{name}_0"] = len(document["accessors"])
        document["accessors"].append({key: accessor[key] for key in ("componentType", "count", "type")})  # zeros
    return as_glb(document, binary)
