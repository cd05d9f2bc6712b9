import errno
import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from hnerf.errors import InputError
from tasks import source as module
from tasks.source import path_or_url, read_capture, require_unchanged


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "ada"
    (root / "images").mkdir(parents=True)
    (root / "images" / "0.jpg").write_bytes(b"pixels")
    (root / "intri.yml").write_text("K")
    (root / "ground_truth").mkdir()
    (root / "ground_truth" / "mesh.ply").write_text("exact")
    return root


def digest(folder: Path) -> str:
    return read_capture(folder)[0].digest


def test_digest_depends_on_content_not_on_place_or_time(folder: Path, tmp_path: Path) -> None:
    before = digest(folder)
    os.utime(folder / "intri.yml", (0, 0))
    moved = folder.rename(tmp_path / "elsewhere")
    assert digest(moved) == before
    assert read_capture(moved)[0].name == "elsewhere"


def test_a_single_video_is_a_capture(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"pixels")
    (tmp_path / "other.mp4").write_bytes(b"of no concern")
    recorded, truth = read_capture(tmp_path / "clip.mp4")
    (tmp_path / "other.mp4").unlink()
    assert read_capture(tmp_path / "clip.mp4") == (recorded, truth)
    (tmp_path / "clip.mp4").write_bytes(b"others")
    assert read_capture(tmp_path / "clip.mp4")[0].digest != recorded.digest
    assert truth.digest == read_capture(tmp_path / "clip.mp4")[1].digest


def test_hidden_files_do_not_count(folder: Path) -> None:
    before = digest(folder)
    (folder / ".DS_Store").write_text("x")
    assert digest(folder) == before


def test_recording_and_ground_truth_have_separate_digests(folder: Path) -> None:
    recorded, truth = read_capture(folder)
    (folder / "ground_truth" / "mesh.ply").write_text("other")
    recorded_now, truth_now = read_capture(folder)
    assert recorded_now == recorded
    assert truth_now.digest != truth.digest
    assert truth.root == folder


@pytest.mark.parametrize("change", ["edited", "added", "gone", "moved"])
def test_a_ground_truth_that_changed_meanwhile_is_refused(folder: Path, change: str) -> None:
    _, truth = read_capture(folder)
    (folder / "intri.yml").write_text("the recording is not read again")
    require_unchanged(truth)
    mesh = folder / "ground_truth" / "mesh.ply"
    match change:
        case "edited":
            mesh.write_text("other")
        case "added":
            (folder / "ground_truth" / "more.ply").touch()
        case "gone":
            mesh.unlink()
        case "moved":
            folder.rename(folder.with_name("elsewhere"))
    with pytest.raises(InputError, match="ada/ground_truth: changed or moved since the command started; run the same"):
        require_unchanged(truth)


def test_a_recording_that_changed_meanwhile_is_refused(folder: Path) -> None:
    recorded, _ = read_capture(folder)
    (folder / "ground_truth" / "mesh.ply").write_text("not part of it")
    require_unchanged(recorded)
    (folder / "images" / "0.jpg").write_bytes(b"others")
    with pytest.raises(InputError, match="ada: changed or moved since the command started; run the same"):
        require_unchanged(recorded)


def test_an_unchanged_video_without_ground_truth_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"pixels")
    for part in read_capture(tmp_path / "clip.mp4"):
        require_unchanged(part)


@pytest.mark.parametrize("change", ["bytes", "name", "new", "gone", "link"])
def test_digest_changes_with_content(folder: Path, change: str) -> None:
    before = digest(folder)
    image = folder / "images" / "0.jpg"
    match change:
        case "bytes":
            image.write_bytes(b"pixelz")
        case "name":
            image.rename(folder / "images" / "1.jpg")
        case "new":
            (folder / "images" / "ground_truth").write_text("a file of that name further down counts")
        case "gone":
            image.unlink()
        case "link":
            (folder / "images" / "1.jpg").symlink_to("0.jpg")
    assert digest(folder) != before


def test_links_and_devices_are_not_followed(folder: Path) -> None:
    outside = folder.with_name("outside.jpg")
    outside.write_bytes(b"pixels")
    (folder / "images" / "link.jpg").symlink_to(outside)
    os.mkfifo(folder / "images" / "pipe.jpg")
    before = digest(folder)
    outside.write_bytes(b"pixelz")
    assert digest(folder) == before


def test_a_file_name_that_is_not_utf_8_counts_by_its_bytes(folder: Path) -> None:
    before = digest(folder)
    (folder / os.fsdecode(b"caf\xe9.txt")).touch()
    named = digest(folder)
    (folder / os.fsdecode(b"caf\xe9.txt")).rename(folder / os.fsdecode(b"caf\xe8.txt"))
    assert len({before, named, digest(folder)}) == 3


def test_a_folder_whose_name_is_not_utf_8_is_bad_input(folder: Path) -> None:
    with pytest.raises(InputError, match="jos�: the folder's name is not UTF-8; rename it"):
        read_capture(folder.rename(folder.with_name(os.fsdecode(b"jos\xe9"))))


def test_a_line_break_in_a_name_is_bad_input(folder: Path) -> None:
    """Otherwise the listing of one file could equal that of two others."""
    (folder / "a\nb").touch()
    with pytest.raises(InputError, match="a b: has a line break in its name"):
        digest(folder)
    (folder / "a\nb").unlink()
    (folder / "link").symlink_to("a\nb")
    with pytest.raises(InputError, match="link: has a line break"):
        digest(folder)
    (folder / "link").unlink()
    with pytest.raises(InputError, match="the folder's name has a line break"):
        digest(folder.rename(folder.with_name("a\nb")))


@pytest.mark.parametrize("name", ["images/1\n.jpg", "ground_truth/z\n.ply", "images/locked.jpg", "images/sparse.mp4"])
def test_what_is_wrong_with_a_file_is_said_before_any_is_read(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading them may take hours."""
    (folder / name).touch()
    if "sparse" in name:
        os.truncate(folder / name, module.MAX_FILE_BYTES + 1)
    opened, reads = Path.open, Mock(side_effect=module.sha256_of)

    def locked(path: Path, *mode: str) -> object:
        if "locked" in path.name:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, *mode)

    monkeypatch.setattr(Path, "open", locked)
    monkeypatch.setattr(module, "sha256_of", reads)
    with pytest.raises(InputError, match=name.partition("\n")[0]):
        read_capture(folder)
    assert reads.call_count == 0


def test_a_file_that_is_too_large_is_bad_input(folder: Path) -> None:
    with (folder / "sparse.mp4").open("wb") as file:
        file.truncate(module.MAX_FILE_BYTES + 1)
    with pytest.raises(InputError, match=r"sparse\.mp4: has more than 256 GiB"):
        digest(folder)


def test_unreadable_files_and_folders_are_bad_input(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused = Mock(side_effect=PermissionError(13, "Permission denied", "images"))

    with monkeypatch.context() as locked, pytest.raises(InputError, match=r"0\.jpg: cannot be read \(Permission"):
        locked.setattr(module, "sha256_of", refused)
        read_capture(folder)
    monkeypatch.setattr(os, "scandir", refused)
    with pytest.raises(InputError, match=r"images: cannot be read \(Permission denied\); make it readable"):
        read_capture(folder)


@pytest.mark.parametrize("away", [errno.ESTALE, errno.ENOTCONN, errno.ECONNABORTED])  # the last two: sshfs has ended
def test_a_share_that_is_away_is_not_bad_input(folder: Path, monkeypatch: pytest.MonkeyPatch, away: int) -> None:
    monkeypatch.setattr(module, "sha256_of", Mock(side_effect=OSError(away, os.strerror(away))))
    with pytest.raises(OSError, match=os.strerror(away)):
        read_capture(folder)


def test_a_store_in_the_capture_is_bad_input(folder: Path) -> None:
    """Its files would change the capture's digest, so that no artifact would be found again."""
    read_capture(folder, folder.parent / "store")
    with pytest.raises(InputError, match="store: lies in the capture's folder; give --store another folder"):
        read_capture(folder, folder / "store")


def test_a_local_place_is_a_path_and_a_remote_one_a_url() -> None:
    given = ("s3://b/ada", "file:///ada", "ada", Path("ada"))
    assert [path_or_url(one) for one in given] == ["s3://b/ada", Path("/ada"), Path("ada"), Path("ada")]
    with pytest.raises(InputError, match="empty"):
        path_or_url("")
