"""Shrink a glTF binary file for a web page: opaque images become JPEG, blend shapes are rounded to compress better
(glTF 2.0 specification, Khronos Group)."""

import json
import struct
from typing import Any

import cv2
import numpy as np

from hnerf.evaluation.pictures import shrunk

JPEG_QUALITY = 90
TARGET_STEPS = {"POSITION": 2.0**-15, "NORMAL": 2.0**-7}  # 0.03 mm, and half a degree
LIMITS = ("min", "max")
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def compact_glb(glb: bytes, texture_px: int) -> bytes:
    """Return the file with each opaque image as a JPEG whose longer side is at most texture_px, and with the offsets of
    morph targets rounded to TARGET_STEPS. All else is unchanged."""
    document, binary = read_glb(glb)
    steps = _steps_of_targets(document)
    images = {image["bufferView"]: image for image in document.get("images", []) if "bufferView" in image}
    packed = bytearray()
    for index, view in enumerate(document["bufferViews"]):
        start = view.get("byteOffset", 0)
        content = binary[start : start + view["byteLength"]]
        if index in images and (jpeg := _jpeg(content, texture_px)):
            content, images[index]["mimeType"] = jpeg, "image/jpeg"
        elif index in steps:
            content = _rounded(content, steps[index])
        packed.extend(bytes(-len(packed) % 4))
        view |= {"byteOffset": len(packed), "byteLength": len(content)}
        packed.extend(content)
    document["buffers"] = [{"byteLength": len(packed)}]
    return as_glb(document, bytes(packed))


def read_glb(glb: bytes) -> tuple[dict[str, Any], bytes]:
    """Return a binary file's JSON document and its binary chunk."""
    (json_length,) = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20 : 20 + json_length]), glb[28 + json_length :]


def as_glb(document: dict[str, Any], binary: bytes) -> bytes:
    """Return a binary file. Chunks are padded to multiples of four bytes, JSON with spaces and binary with zeros."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(binary), BINARY_CHUNK) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _steps_of_targets(document: dict[str, Any]) -> dict[int, float]:
    """Return the rounding step of each morph target, by the buffer view of its values. Round its limits, too."""
    steps = {}
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            for target in primitive.get("targets", []):
                for name, index in target.items():
                    accessor, step = document["accessors"][index], TARGET_STEPS[name]
                    steps[accessor.get("sparse", {}).get("values", accessor)["bufferView"]] = step
                    accessor |= {end: (np.round(np.divide(accessor[end], step)) * step).tolist() for end in LIMITS}
    return steps


def _rounded(content: bytes, step: float) -> bytes:
    """Return float32 numbers rounded to multiples of a power of two, so that their last bits are zero."""
    return (np.round(np.frombuffer(content, "<f4") / step) * step).astype("<f4").tobytes()


def _jpeg(content: bytes, texture_px: int) -> bytes | None:
    """Return an image as JPEG; None if it has more than three channels or cannot be read."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 3:
        return None
    return cv2.imencode(".jpg", shrunk(image, texture_px), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
