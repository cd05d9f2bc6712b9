"""A lease of work among machines: who works on an artifact, as long as they show that they are alive.

    <stage>/<key>.lease.<turn>    who works on the artifact and where, and a count that goes up; or FREE, once given up

Turns are numbered from 0. A turn is taken by making its object, which the file system allows one worker only. The owner
changes it every BEAT_S. The next turn may be taken once the last is FREE, or has not changed for EXPIRY_S by the clock
of the one who waits: clocks of machines are not compared. If the owner ran where this one runs, it may be taken as soon
as its process is gone. What is finished needs no lease, and its turns are removed.

A turn is not taken back from an owner who was silent for too long and goes on: then two compute the same.
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

    Yields False, without the lease, once another worker that held it has ended or was faster: its result may be there.
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
        with suppress(BucketError, InputError):  # else it expires
            if finished:
                for taken in range(turn, -1, -1):  # the last one first: turns are counted up to the first gap
                    bucket.remove(_note(name, taken))
            else:
                bucket.write_note(_note(name, turn), FREE)


def _take(bucket: Bucket, name: str) -> int | None:
    """Return the turn that this worker got, None if another one has it, or had it and ended."""
    turn, text = _last(bucket, name)
    if text != FREE and turn >= 0 and not _expires(bucket, name, turn, text):
        return None
    return turn + 1 if bucket.create_note(_note(name, turn + 1), _text(0)) else None


def _last(bucket: Bucket, name: str) -> tuple[int, bytes]:
    """Return the last turn that was taken, and its text; -1 if none was."""
    turn, text = -1, FREE
    while (following := bucket.read_note(_note(name, turn + 1))) is not None:
        turn, text = turn + 1, following
    return turn, text


def _expires(bucket: Bucket, name: str, turn: int, text: bytes) -> bool:
    """Wait for the owner of a turn; return whether it fell silent, or is gone."""
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
    """Return whether an owner by its text ran in this place, and does no more. A number that another process has got
    meanwhile counts as alive."""
    owner, _, rest = text.decode(errors="replace").partition(" ")
    number = owner.rpartition(":")[2]
    return rest.partition(" ")[0] == _place() and number.isdecimal() and not Path(f"/proc/{number}").exists()


@cache
def _place() -> str:
    """Return what numbers of processes refer to: this start of this machine, and its name space."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{boot}/{os.stat('/proc/self/ns/pid').st_ino}"


def _note(name: str, turn: int) -> str:
    return f"{name}.lease.{turn}"
