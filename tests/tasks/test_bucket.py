import errno
import socket
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import pytest
from fsspec import filesystem, get_filesystem_class

from hnerf.errors import InputError, PlaceError
from tasks.bucket import VARIABLE, Bucket, BucketError


def test_a_bucket_is_used_only_if_it_is_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Bucket.configured() is None
    monkeypatch.setenv(VARIABLE, f"file://{tmp_path}/")
    bucket = Bucket.configured()
    assert bucket is not None and bucket.where("fit/k.tar") == f"file://{tmp_path}/fit/k.tar"


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("nothing://x", "HNERF_BUCKET: .*nothing.*; give a URL like"),
        ("s3://[", "HNERF_BUCKET: .*Invalid IPv6 URL; give a URL like"),
        ("github://ada", "HNERF_BUCKET: .*missing.*'org'.*; give a URL like"),
        ("file:///no/such/folder", "HNERF_BUCKET: .*/no/such/folder is not there; make it"),
        ("memory://unmade", "is not there; make it"),
        ("https://example.com/x", "HNERF_BUCKET: https://example.com/x: is no bucket; download it and give the file"),
    ],
)
def test_the_error_of_a_bucket_that_cannot_be_opened_is_one_line(
    url: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, url)
    with pytest.raises(InputError, match=why):
        Bucket.configured()


def test_objects_are_uploaded_downloaded_and_removed(tmp_path: Path) -> None:
    bucket = Bucket.at(f"file://{tmp_path}")
    (tmp_path / "here").write_text("abc")
    bucket.upload(tmp_path / "here", "a/b")
    assert bucket.size_bytes("a/b") == 3
    bucket.download("a/b", tmp_path / "there")
    assert (tmp_path / "there").read_text() == "abc"
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]
    bucket.remove("a/b")
    bucket.remove("a/b")
    assert bucket.size_bytes("a/b") is None
    with pytest.raises(FileNotFoundError):
        bucket.download("a/b", tmp_path / "there")


def test_a_full_disk_is_not_reported_as_an_unreachable_bucket(tmp_path: Path) -> None:
    """The disk that is full is the local one, to which the object is downloaded."""
    (tmp_path / "object").write_text("abc")
    with pytest.raises(BucketError, match=r"object: .*No space left on device; make room$"):
        Bucket.at(f"file://{tmp_path}").download("object", Path("/dev/full"))


def test_an_interrupted_upload_leaves_the_object_unchanged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def half(fs: object, path: str, where: str) -> None:
        Path(where).write_text(Path(path).read_text()[:1])
        raise OSError(errno.ENOSPC, "No space left on device")

    bucket = Bucket.at(f"file://{tmp_path}")
    for text in ("old", "new"):
        (tmp_path / text).write_text(text)
    bucket.upload(tmp_path / "old", "a/b")
    monkeypatch.setattr(type(bucket.fs), "put_file", half)
    with pytest.raises(BucketError, match="No space left"):
        bucket.upload(tmp_path / "new", "a/b")
    assert [(path.name, path.read_text()) for path in (tmp_path / "a").iterdir()] == [("b", "old")]


@pytest.mark.parametrize("kind", ["file", "s3"])
def test_of_concurrent_writers_one_creates_a_note(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    bucket = Bucket.at(f"file://{tmp_path}" if kind == "file" else request.getfixturevalue("s3"))
    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(lambda number: bucket.create_note("raced", b"%d" % number), range(8))) == 1
    assert bucket.read_note("a/n") is None
    assert bucket.create_note("a/n", b"1")
    assert not bucket.create_note("a/n", b"2")
    assert bucket.read_note("a/n") == b"1"
    bucket.write_note("a/n", b"3" * 2000)
    assert bucket.read_note("a/n") == b"3" * 1000


def test_the_error_of_an_unreachable_bucket_is_one_line(s3: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(get_filesystem_class("s3"), "retries", 1)
    once = {"retries": {"max_attempts": 0}}
    away = Bucket(filesystem("s3", endpoint_url="http://127.0.0.1:9", config_kwargs=once), "tests/shared")
    with pytest.raises(BucketError, match=r"^s3://tests/shared/x: Could not connect .*; can the bucket be reached\?$"):
        away.size_bytes("x")


def test_an_empty_place_in_a_bucket_has_no_folders_and_files(s3: str) -> None:
    bucket = Bucket.at(f"{s3}/nothing-yet")
    assert bucket.folders() == [] and list(bucket.files("ada")) == []


def test_a_missing_bucket_is_refused_and_not_created(s3: str) -> None:
    with pytest.raises(PlaceError, match="s3://none/x: none is not there; make it"):
        Bucket.at("s3://none/x")


def test_a_server_that_refuses_the_connection_is_a_bucket_error() -> None:
    """Some file systems, such as that of FTP, connect as soon as they are made."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(BucketError, match=rf"^ftp://127\.0\.0\.1:{port}/x: .*refused; can the bucket be reached\?$"):
        Bucket.at(f"ftp://127.0.0.1:{port}/x")


def test_a_vanished_network_share_is_a_bucket_error(tmp_path: Path) -> None:
    """A heartbeat must survive this, and an upload must be repeated."""
    (tmp_path / "share").mkdir()
    bucket = Bucket.at(f"file://{tmp_path}/share")
    (tmp_path / "share").rmdir()
    with pytest.raises(BucketError, match="can the bucket be reached"):
        bucket.write_note("n", b"1")
    assert bucket.read_note("n") is None


def test_expired_credentials_are_an_error_of_the_place_not_of_the_recording(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bucket = Bucket.at(f"file://{tmp_path}")

    monkeypatch.setattr(type(bucket.fs), "info", Mock(side_effect=PermissionError("The provided token has expired.")))
    with pytest.raises(PlaceError, match="token has expired"):
        bucket.size_bytes("x")
