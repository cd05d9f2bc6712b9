"""Small videos with what phones and camcorders write but OpenCV does not: a rotation, an uneven frame rate, edit lists,
interlaced pictures."""

import base64
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

# Matrices of tkhd: of the columns of its first two rows, the first two say where x and y of the picture go.
QUARTER_TURN = (0, 1, -1, 0)  # clockwise
LEFT_TO_RIGHT, TOP_TO_BOTTOM, TRANSPOSED = (-1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0)  # mirrored
CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts")
# A file with two interlaced pictures of 32 x 32 px that differ, encoded by x264.
INTERLACED = zlib.decompress(
    base64.b85decode(
        "c-muNU{FXasVvAW&d+6FU}6B#Kx~v)mTZ_?U}DI?z`&7Kl$r{p!*f#-OMtX}YDbff`M3Sbn`3v1@XEcN^kh@hVatP8*XB=dyZ`^|bbBfB(8bQ1"
        "=ky-_Yu&2+Ww(xY^5M`Br62{nzh*r3W{w~u9cL+5nqU5?z`(%Fo|~Uv1{BN5Ez3w@Kmp7zfJ6WTBLfH_03)g@biM-vUcdxIVI@V0*+6zoNjBI{"
        "W-O)!VCW>qUIi#-U{Fa-DJcfhGO0PmB}h5~5PBKU<)&mNf^_7jp!?kjh*=mykAOM487VnMFqyK<lvHGuVL*PqM`B(|PAW(ZV`Xk;UK)@gQkDxg"
        "6xo?7DG)iCl%mu$BuDX-7Ud{F*o>CNB}q9z_Rivx;uIt`D?w=jM^Jz~t-#;`q&;9Nczl5B6>>6@DvZobutkK#|NlTzAE?Ti(bqxr|3e0`bRhjn"
        "bb}x$Mi@bak-UhO2O|Sp#_xtmod%$Cfr7;10;mH(SR|>W2pYO_cVGq=mw-ba=1?Xu0;&ai2w5D2Wq@MIXktuAa#g4)hrt;XSP-+4^O5u!0I_Xp"
        "N(m@7O><MhGzcgn#~d)WixLY8a*#uTBNLcB01K0a$^"
    )
)


def write_video(path: Path, levels: list[int], size_px: tuple[int, int] = (96, 64), fps: float = 25) -> None:
    """Write a video of uniform grey frames; the right half of each is black."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size_px)
    for level in levels:
        picture = np.full((size_px[1], size_px[0], 3), level, np.uint8)
        picture[:, size_px[0] // 2 :] = 0
        writer.write(picture)
    writer.release()


def show_as(path: Path, matrix: tuple[int, int, int, int], wide: bool = False) -> None:
    """Mark a video as to be shown turned or mirrored. wide: whether to write 64-bit times."""
    a, b, c, d = (part << 16 for part in matrix)
    packed = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)

    def shown(content: bytes) -> bytes:
        version, created, modified, track, reserved, length = struct.unpack(">6I", content[:24])
        numbers = version | wide << 24, created, modified, track, reserved, length
        return struct.pack(">IQQIIQ" if wide else ">6I", *numbers) + content[24:40] + packed + content[76:]

    _edit(path, b"tkhd", shown)


def hold_frames(path: Path, first: int, rest: int) -> None:
    """Make the `rest` frames of a video after the first `first` last twice as long."""

    def slower(content: bytes) -> bytes:
        (step,) = struct.unpack(">I", content[12:16])
        return struct.pack(">IIIIII", 0, 2, first, step, rest, 2 * step)

    _edit(path, b"stts", slower)
    path.write_bytes(path.read_bytes().replace(b"edts", b"free"))  # the edit list would cut it to its old length


def trim(path: Path, *edits: tuple[int | None, int], wide: bool = False) -> None:
    """Make a video show only some frames, as after trimming without encoding again. edits: the first frame, None for
    showing nothing, and the number of frames; wide: whether to write 64-bit numbers."""
    content = path.read_bytes()
    movie_rate, rate = (_number(content, kind, 12) for kind in (b"mvhd", b"mdhd"))
    step, form = _number(content, b"stts", 12), ">QqI" if wide else ">IiI"
    listed = [
        struct.pack(form, count * step * movie_rate // rate, -1 if first is None else first * step, 1 << 16)
        for first, count in edits
    ]
    _edit(path, b"elst", lambda _: struct.pack(">II", wide << 24, len(edits)) + b"".join(listed))


def state_transfer(path: Path, transfer: int) -> None:
    """Make a video state the transfer characteristics of its colours, as `colr`."""
    _state(path, box(b"colr", b"nclx" + struct.pack(">HHHB", 9, transfer, 9, 0)))


def state_pixel_aspect(path: Path, width: int, height: int) -> None:
    """Make a video state the aspect ratio of its pixels, as `pasp`."""
    _state(path, box(b"pasp", struct.pack(">II", width, height)))


def _state(path: Path, stated: bytes) -> None:
    """Put a box behind those that describe a video's pictures."""

    def described(content: bytes) -> bytes:
        size, kind = struct.unpack(">I4s", content[8:16])
        return content[:8] + box(kind, content[16 : 8 + size] + stated)

    _edit(path, b"stsd", described)


def declare_samples(path: Path, count: int) -> None:
    """Make a video declare this many samples of one byte each."""
    _edit(path, b"stsz", lambda _: struct.pack(">III", 0, 1, count))
    _edit(path, b"stsc", lambda _: struct.pack(">IIIII", 0, 1, 1, count, 1))
    _edit(path, b"stts", lambda _: struct.pack(">IIII", 0, 1, count, 1))


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


def _number(content: bytes, kind: bytes, at: int) -> int:
    """Return the 32-bit number at offset `at` in the first box of a kind."""
    start = content.index(kind) + 4 + at
    return int.from_bytes(content[start : start + 4], "big")


def _edit(path: Path, wanted: bytes, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(_edited(path.read_bytes(), wanted, change))


def _edited(content: bytes, wanted: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """Return boxes with the content of one kind of box changed. moov comes last, so no offset changes."""
    done, at = b"", 0
    while at < len(content):
        size, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        inner = content[at + 8 : at + size]
        if kind == wanted:
            inner = change(inner)
        elif kind in CONTAINERS:
            inner = _edited(inner, wanted, change)
        done += box(kind, inner)
        at += size
    return done
