"""FBX and Alembic, written by Blender's own exporters.

Blender is a program of its own here: its module (bpy) needs an older NumPy, and it is under the GPL.
"""

import os
import shutil
import signal
import subprocess
import tempfile
from functools import partial
from pathlib import Path

from hnerf.errors import InputError
from hnerf.processes import end_with_parent

FILES = ("avatar.fbx", "avatar_cache.abc")
SCRIPT = Path(__file__).with_name("blender_script.py")
BLENDER = ("--background", "--factory-startup", "--python-exit-code", "1", "--python")
PYTHON = ("-I",)  # without the folder of the script, whose modules hide others, and without PYTHONPATH
LIMIT_S = 3600.0
ADVICE = "give --blender Blender 4.5 or newer, or a Python that has bpy"


def require_blender(program: str) -> None:
    """Raise InputError unless `write_with_blender` can use a program."""
    with tempfile.TemporaryDirectory() as folder:
        _run(program, Path(folder))


def write_with_blender(out: Path, program: str, fps: float) -> None:
    """Write FILES from `avatar.usdz` and `avatar_cache.usdz` in the folder `out`. program: Blender, or a Python that
    has bpy, whose name then begins with "python"; fps: of the capture. Raises InputError if it fails."""
    _run(program, out, str(fps))
    for name in FILES:
        if not (out / name).is_file():
            raise InputError(f"{program}: wrote no {name}; {ADVICE}")


def _run(program: str, folder: Path, *arguments: str) -> None:
    """Run the script in a folder. Raises InputError with the last error that the program prints."""
    found = shutil.which(program)
    if found is None:
        raise InputError(f"{program}: no such program; {ADVICE}")
    options = PYTHON if Path(found).name.startswith("python") else BLENDER
    with tempfile.TemporaryFile() as printed:
        try:
            process = subprocess.Popen(
                [os.path.abspath(found), *options, str(SCRIPT), "--", *arguments],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=partial(end_with_parent, signal.SIGKILL, os.getpid()),
            )
        except OSError as error:
            raise InputError(f"{program}: cannot be started ({error.strerror}); {ADVICE}") from None
        try:
            status = process.wait(LIMIT_S)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)  # a script around Blender, and Blender
            process.wait()
            if isinstance(error, subprocess.TimeoutExpired):
                raise InputError(f"{program}: took over {LIMIT_S:.0f} s; {ADVICE}") from None
            raise
        if status:
            printed.seek(0)
            lines = [line for line in printed.read().decode(errors="replace").splitlines() if line.strip()]
            why = [line for line in lines if "Error" in line] or lines or [f"exit code {status}"]
            raise InputError(f"{program}: {why[-1].strip()}; {ADVICE}")
