"""The commands of `hnerf store`: inspect the store and clean it up. Each function's docstring is its command's help."""

import argparse
import re
import shutil
import time
from argparse import ArgumentTypeError
from pathlib import Path
from typing import TYPE_CHECKING

from flows.arguments import MAX_COUNT, number, path
from hnerf.errors import InputError, printable

if TYPE_CHECKING:  # importing Prefect takes seconds; help must not wait for that
    from tasks.store import Store

UNITS_S = {"d": 86400, "h": 3600, "m": 60, "s": 1}


def list_(options: argparse.Namespace) -> None:
    """List the subjects: size, first and latest result, and capture folder."""
    from tasks.garbage import find_garbage
    from tasks.inventory import NOBODY, Inventory

    inventory = Inventory.of(_store(options))
    rows = []
    for subject in sorted(inventory.latest.keys() | {name for names in inventory.owners.values() for name in names}):
        mine = inventory.of_subject(subject)
        if mine:
            recording = inventory.store.recording_folder(subject)
            rows.append((subject, mine, "" if subject in inventory.latest else "no results", recording))
    if nobodys := [inventory.stored[name] for name, names in inventory.owners.items() if not names]:
        rows.append((NOBODY, sorted(nobodys, key=lambda one: one.made_s), "nobody's", ""))
    print(f"{'subject':<24} {'size':>9} {'artifacts':>9}  {'since':<16}  {'latest':<16}  recording")
    for subject, mine, note, recording in rows:
        since, latest = _date(mine[0].made_s), _date(mine[-1].made_s)
        size = _size(sum(one.size_bytes for one in mine))
        print(f"{printable(subject):<24} {size:>9} {len(mine):>9}  {since}  {latest}  {printable(note or recording)}")
    total = sum(one.size_bytes for one in inventory.stored.values())
    free = shutil.disk_usage(inventory.store.root).free
    garbage = sum(one.size_bytes for one in find_garbage(inventory, 1, 0))
    print(f"all: {_size(total)}; not needed: {_size(garbage)}; free on this disk: {_size(free)}")


def show(options: argparse.Namespace) -> None:
    """List the artifacts of a subject, and mark the latest."""
    from tasks.inventory import Inventory

    inventory = Inventory.of(_store(options))
    latest = inventory.latest.get(options.name, {})
    mine = inventory.of_subject(options.name)
    if not mine:
        raise InputError(f"{options.name}: no such subject in {options.store}; `hnerf store list` names them")
    print(f"recording: {printable(inventory.store.recording_folder(options.name)) or 'unknown'}")
    print(f"{'made':<16}  {'used':<16}  {'size':>9} {'files':>6}  latest  artifact")
    for one in mine:
        mark = "yes" if one.artifact.name in latest.values() else ""
        size, count = _size(one.size_bytes), len(one.artifact.files)
        print(f"{_date(one.made_s)}  {_date(one.used_s)}  {size:>9} {count:>6}  {mark:<6}  {one.artifact.name}")


def verify(options: argparse.Namespace) -> None:
    """Check every file against its recorded digest."""
    from tasks.verify import faults

    found = faults(_store(options), options.names)
    for fault in found.lines:
        print(printable(fault))
    print(f"checked: {found.artifacts} artifacts, {found.files} files, {_size(found.size_bytes)}")
    if found.lines:
        remedy = "repeat the `hnerf run` of what is damaged, or let `hnerf store gc --yes` remove what nobody needs"
        raise InputError(f"{options.store}: faults: {len(found.lines)}; {remedy}")


def gc(options: argparse.Namespace) -> None:
    """List what no subject needs and what interrupted work left behind; with --yes, remove it."""
    from tasks.garbage import collect, find_garbage
    from tasks.inventory import Inventory

    store = _store(options)
    inventory = Inventory.of(store)
    garbage = find_garbage(inventory, options.keep, options.older)
    for one in garbage:
        name = f"{one.stage}/{one.key}"
        owners = ", ".join(sorted(inventory.owners.get(name, ()))) or "-"
        print(f"{_size(one.size_bytes):>9}  {one.what:<10}  {name}  {printable(owners)}")
    removed = [one for one in garbage if options.yes and collect(store, one)]
    size = _size(sum(one.size_bytes for one in (removed if options.yes else garbage)))
    if options.yes:
        left = len(garbage) - len(removed)
        in_use = f"; {left} came into use meanwhile" if left else ""
        print(f"removed: {len(removed)} of {len(garbage)}, {size}{in_use}")
    elif garbage:
        print(f"not needed: {len(garbage)}, {size}; nothing was removed: give --yes to remove")
    else:
        print("not needed: nothing")


def export(options: argparse.Namespace) -> None:
    """Pack the latest results of a subject, and all that they were computed from, into an archive."""
    from tasks.archive import export_subject

    out = options.out or Path(f"{options.name}.tar")
    manifest = export_subject(_store(options), options.name, out)
    print(f"archive: {out} ({len(manifest.artifacts)} artifacts, {_size(out.stat().st_size)})")


def import_(options: argparse.Namespace) -> None:
    """Unpack an archive of `hnerf store export` into a store; import only from people whom you trust."""
    from tasks.archive import import_subject
    from tasks.store import Store

    manifest = import_subject(Store(options.store.resolve()), options.archive)
    print(f"subject: {options.store / 'subjects' / manifest.subject} ({len(manifest.artifacts)} artifacts)")


def add_store_commands(store: argparse.ArgumentParser) -> None:
    """Add `list` and the others to the parser of `hnerf store`."""
    actions = store.add_subparsers(required=True, metavar="ACTION")
    added = {}
    for action in (list_, show, verify, gc, export, import_):
        what = action.__doc__
        name = action.__name__.strip("_")
        added[name] = actions.add_parser(name, help=what, description=what)
        added[name].set_defaults(command=action)
    for name in ("show", "export"):
        added[name].add_argument("name", help="subject, as `hnerf store list` shows it")
    what = "check these subjects alone (default: the whole store)"
    added["verify"].add_argument("names", nargs="*", metavar="NAME", help=what)
    what = "remove what is listed; without this, nothing is changed"
    added["gc"].add_argument("--yes", action="store_true", help=what)
    what = "keep the results of the N newest runs of each subject that made an asset (default: 1)"
    added["gc"].add_argument("--keep", type=number(int, 1, MAX_COUNT), default=1, metavar="N", help=what)
    what = "only what has been unused for this long: 30d, 12h, 0 (default: 1d)"
    added["gc"].add_argument("--older", type=duration_s, default="1d", metavar="TIME", help=what)
    added["export"].add_argument("--out", type=path, help="new file to write (default: NAME.tar)")
    added["import"].add_argument("archive", type=path, help="archive of `hnerf store export`")
    for parser in added.values():
        parser.add_argument("--store", type=path, default="store", help="folder of results (default: store)")


def duration_s(text: str) -> float:
    """Return the seconds of a time like 30d, 12h, 5m or 0."""
    matched = re.fullmatch(r"(\d{1,6})([dhms]?)", text)
    if not matched or not (matched[2] or matched[1] == "0"):
        raise ArgumentTypeError("give a time like 30d, 12h or 0")
    return float(int(matched[1]) * UNITS_S.get(matched[2], 0))


def _store(options: argparse.Namespace) -> "Store":
    from tasks.store import Store

    store = Store(options.store.resolve())
    if not store.exists():
        raise InputError(f"{options.store}: not a store; give its folder with --store")
    return store


def _date(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def _size(size_bytes: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if size_bytes < 1000:
            return f"{size_bytes:.0f} B" if unit == "B" else f"{size_bytes:.1f} {unit}"
        size_bytes /= 1000
    return f"{size_bytes:.1f} TB"
