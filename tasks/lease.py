"""A lease by which machines divide work: one works on an artifact as long as it shows that it is alive.

    <stage>/<key>.lease.<turn>    who works on the artifact and where, and a count that goes up; or FREE, once given up

Turns are numbered from 0. A worker takes a turn by creating its object, which the file system allows only one worker to
do. The owner changes it every BEAT_S. The next turn may be taken once the last one is FREE or has not changed for
EXPIRY_S. That time is measured by the waiting worker's clock, so that clocks of different machines are never compared.
If the owner ran in the same place as the waiting worker, the turn may be taken as soon as its process is gone. Finished
work needs no lease, and its turns are removed.

An owner who was silent for too long and then continues is not stopped: two workers then compute the same artifact.
"""

import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Event, Thread

from hnerf.errors import InputError, printable
from tasks.bucket import Bucket, BucketError

log = logging.getLogger("hnerf.lease")

BEAT_S, EXPIRY_S = 30.0, 120.0  # several beats may be lost
LOOK_S = 2.0
FREE = b"free"


@contextmanager
def leased(bucket: Bucket, name: str) -> Iterator[bool]:
    """Hold the lease of an artifact, and give it up if the work inside fails.

    Yields False, without the lease, if another worker that held it has ended or was faster: its result may be there.
    """
    turn = _take(bucket, name)
    if turn is None:
        yield False
        return
    ended = Event()
    beats = Thread(target=_show_life, args=(bucket, _note(name, turn), ended), daemon=True)
    beats.start()
    finished = False
    try:
        yield True
        finished = True
    finally:
        ended.set()
        beats.join()
        with suppress(BucketError, InputError):  # otherwise it expires
            if finished:
                for taken in range(turn, -1, -1):  # the last one first: turns are counted up to the first gap
                    bucket.remove(_note(name, taken))
            else:
                bucket.write_note(_note(name, turn), FREE)


def _take(bucket: Bucket, name: str) -> int | None:
    """Return the turn that this worker got, or None if another worker has it, or had it and has ended."""
    turn, text = _last(bucket, name)
    if text != FREE and turn >= 0 and not _expires(bucket, name, turn, text):
        return None
    return turn + 1 if bucket.create_note(_note(name, turn + 1), _text(0)) else None


def _last(bucket: Bucket, name: str) -> tuple[int, bytes]:
    """Return the last turn that was taken, and its text; -1 if none was taken."""
    turn, text = -1, FREE
    while (following := bucket.read_note(_note(name, turn + 1))) is not None:
        turn, text = turn + 1, following
    return turn, text


def _expires(bucket: Bucket, name: str, turn: int, text: bytes) -> bool:
    """Wait for the owner of a turn; return whether it fell silent or is gone."""
    log.info("waiting for %s, which works on %s", printable(text.decode(errors="replace").partition(" ")[0]), name)
    seen_s = time.monotonic()
    while time.monotonic() - seen_s < EXPIRY_S:
        if _is_gone(text):
            log.warning("%s: the process that worked on it is gone; taking over", name)
            return True
        time.sleep(LOOK_S)
        now = bucket.read_note(_note(name, turn))
        if now is None or now == FREE or bucket.read_note(_note(name, turn + 1)) is not None:
            return False
        if now != text:
            text, seen_s = now, time.monotonic()
    log.warning("%s: who worked on it has been silent for %.0f s; taking over", name, EXPIRY_S)
    return True


def _show_life(bucket: Bucket, note: str, ended: Event) -> None:
    count = 0
    while not ended.wait(BEAT_S):
        count += 1
        try:
            bucket.write_note(note, _text(count))
        except (BucketError, InputError) as error:
            log.warning("%s", error)


def _text(count: int) -> bytes:
    return f"{socket.gethostname()}:{os.getpid()} {_place()} {count}".encode()


def _is_gone(text: bytes) -> bool:
    """Return whether the owner named by this text ran in this place and no longer runs. If another process has got its
    number meanwhile, it counts as alive."""
    owner, _, rest = text.decode(errors="replace").partition(" ")
    number = owner.rpartition(":")[2]
    if rest.partition(" ")[0] != _place() or not number.isdecimal():
        return False
    try:
        with suppress(PermissionError):  # it is another user's, whose processes /proc may hide
            os.kill(int(number), 0)
    except (ProcessLookupError, OverflowError):
        return True
    return False


@cache
def _place() -> str:
    """Return the scope of process numbers: this boot of this machine, and its name space."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{boot}/{os.stat('/proc/self/ns/pid').st_ino}"


def _note(name: str, turn: int) -> str:
    return f"{name}.lease.{turn}"
