"""Pickles of plain data (numbers, text, dicts, lists, numpy arrays), read without executing anything that they name.

Old captures and body models come as pickles, and unpickling executes whatever their author wrote. Here every class that
a pickle may name is replaced by one of the stand-ins below, which only hold what they are given; all others are
refused. Arrays are made afterwards, from bytes of the length that their shape declares.
"""

import io
import math
import pickle
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.sparse

from hnerf.capture.safe_io import read_bytes
from hnerf.errors import InputError, one_line

MAX_CHARACTER = 0x10FFFF
MAX_ITEMS = 10_000_000  # of lists; numbers in arrays do not count
MAX_BYTES = 1_000_000_000  # the largest SMPL-X model has half of that
_DTYPES = re.compile(r"[biufOSU?][0-9]*")


def read_pickle(path: Path) -> Any:
    """Read plain data from a pickle file (text of Python 2 as latin-1); sparse matrices become scipy's CSC arrays,
    chumpy's arrays numpy's. Raises InputError if the file is missing, too large or damaged, or names anything else."""
    return _plain_data(path, io.BytesIO(read_bytes(path, MAX_BYTES)))


def read_pickled_npy(path: Path) -> Any:
    """Read the one Python object of a file that `numpy.save` wrote, as `read_pickle` does."""
    stream = io.BytesIO(read_bytes(path, MAX_BYTES))
    try:
        version = np.lib.format.read_magic(stream)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
    except Exception:  # the header is parsed as a Python literal, which can raise nearly anything, too
        raise InputError(f"{path}: is no .npy file; export it again") from None
    if shape != () or dtype.kind != "O":
        raise InputError(f"{path}: holds no dictionary; export it again")
    stored = _plain_data(path, stream)
    if not isinstance(stored, np.ndarray) or stored.shape != ():
        raise InputError(f"{path}: holds no dictionary; export it again")
    return stored.item()


def _plain_data(path: Path, stream: io.BytesIO) -> Any:
    """Unpickle plain data. Raises InputError if the stream holds anything else."""
    try:
        plain = _plain(_Unpickler(stream, encoding="latin1").load(), {})
        if _size(plain, {}) > MAX_ITEMS:
            raise pickle.UnpicklingError(f"more than {MAX_ITEMS} items")
        return plain
    except Exception as error:  # a damaged pickle can raise nearly anything
        raise InputError(f"{path}: not a pickle of plain data ({one_line(error)}); convert it to .npz") from None


def _size(value: Any, known: dict[int, int]) -> int:
    """Return how many items plain data has, counting each list as often as it occurs: a list that holds one list twice,
    thirty levels deep, becomes a billion items when it is made an array. known: sizes by identity."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        parts: Iterable[Any] = value.flat
    elif isinstance(value, dict | list | tuple):
        parts = value.values() if isinstance(value, dict) else value
    else:
        return 1
    if id(value) not in known:
        known[id(value)] = 1  # for data that contains itself
        known[id(value)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(value)]


class _StandIn:
    """A stand-in for an object in a pickle: it holds the constructor's arguments and the state."""

    state: Any = None

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def plain(self, done: dict[int, Any]) -> Any:
        """Return the plain data that the object represents; `done` as in `_plain`."""
        raise pickle.UnpicklingError(f"{type(self).__name__} is no data")


class _Dtype(_StandIn):
    """A numpy.dtype(code, align, copy) with state (version, byte order, ...): numbers, text, or Python objects."""

    def plain(self, done: dict[int, Any]) -> Any:
        code, order = self.arguments[0], self.state[1] if self.state else "|"
        if not isinstance(code, str) or not _DTYPES.fullmatch(code) or order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("an array of an unknown type")
        return np.dtype(code).newbyteorder(order)  # type: ignore[arg-type]


class _Array(_StandIn):
    """A numpy.ndarray with state (version, shape, dtype, column-major, bytes or list of objects)."""

    def plain(self, done: dict[int, Any]) -> Any:
        _, shape, kind, column_major, data = self.state
        dtype = _plain(kind, done)
        if dtype.kind != "O":
            flat = _from_bytes(data, dtype)
        else:
            flat = np.empty(len(data), object)
            flat[:] = [_plain(item, done) for item in data]
        if not all(isinstance(n, int) and n >= 0 for n in shape) or math.prod(shape) != len(flat):
            raise pickle.UnpicklingError("an array of another size than it declares")
        return flat.reshape(shape, order="F" if column_major else "C")


class _Buffer(_StandIn):
    """A numpy._core.numeric._frombuffer(bytes, dtype, shape, order, axes), an array in protocol 5; axes of order K."""

    def plain(self, done: dict[int, Any]) -> Any:
        data, dtype, shape, order, *axes = self.arguments
        array = _Array()
        array.state = (1, shape, dtype, order == "F", data)
        return array.plain(done).transpose(axes[0]) if order == "K" else array.plain(done)


class _Scalar(_StandIn):
    """A numpy.core.multiarray.scalar(dtype, bytes)."""

    def plain(self, done: dict[int, Any]) -> Any:
        dtype, data = self.arguments
        return _from_bytes(data, _plain(dtype, done))[0]


class _Sparse(_StandIn):
    """A scipy.sparse.csc_matrix with its attributes as state."""

    def plain(self, done: dict[int, Any]) -> Any:
        parts = _plain(self.state, done)
        shape = tuple(int(n) for n in parts["_shape" if "_shape" in parts else "shape"])
        matrix = scipy.sparse.csc_array((parts["data"], parts["indices"], parts["indptr"]), shape=shape)
        matrix.check_format(full_check=True)
        return matrix


class _Chumpy(_StandIn):
    """A chumpy.Ch, an array of a package that is no longer maintained: its value is the attribute x."""

    def plain(self, done: dict[int, Any]) -> Any:
        return np.asarray(_plain(self.state["x"], done))


def _from_bytes(data: Any, dtype: np.dtype[Any]) -> np.ndarray:
    """Return an array of the items that bytes, or text of Python 2, hold. numpy accepts any character code, but Python
    later fails on those that Unicode does not have."""
    flat = np.frombuffer(data.encode("latin1") if isinstance(data, str) else data, dtype)
    if (
        dtype.kind == "U"
        and flat.size
        and flat.view(np.dtype("u4").newbyteorder(dtype.byteorder)).max() > MAX_CHARACTER
    ):
        raise pickle.UnpicklingError("characters that Unicode does not have")
    return flat


def _reconstructed(kind: Any, *_: Any) -> _StandIn:
    """Create a stand-in as numpy's _reconstruct(class, shape, type) and copyreg's _reconstructor(class, base, state)
    would; its state follows."""
    if not (isinstance(kind, type) and issubclass(kind, _StandIn)):
        raise pickle.UnpicklingError("a class of an unknown kind")
    return kind()


def _with_keys(code: bytes, keys: slice) -> Callable[[Any], None]:
    """Return an opcode's handler that loads dictionary items but refuses tuples as keys. keys: their slice of the
    stack."""

    def load(unpickler: Any) -> None:
        if any(isinstance(key, tuple) for key in unpickler.stack[keys]):
            raise pickle.UnpicklingError("a tuple for a key")
        pickle._Unpickler.dispatch[code[0]](unpickler)

    return load


def _refused(unpickler: Any) -> None:
    """Refuse an opcode that hashes its contents."""
    raise pickle.UnpicklingError("it holds a set")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    ("_codecs", "encode"): lambda text, _: text.encode("latin1"),  # as Python 3 writes bytes for Python 2
    ("__builtin__", "bytes"): lambda: b"",  # without arguments, as Python 3 writes empty bytes for Python 2
    ("copy_reg", "_reconstructor"): _reconstructed,
    ("copyreg", "_reconstructor"): _reconstructed,
    ("__builtin__", "object"): object,
    ("builtins", "object"): object,
    # A set's items unhashed: no set is used, and tuples with shared parts can take forever to hash.
    **{(module, "set"): lambda items: items for module in ("__builtin__", "builtins")},
    ("chumpy.ch", "Ch"): _Chumpy,
    **{(module, "_reconstruct"): _reconstructed for module in ("numpy.core.multiarray", "numpy._core.multiarray")},
    **{(module, "_frombuffer"): _Buffer for module in ("numpy.core.numeric", "numpy._core.numeric")},
    **{(module, "scalar"): _Scalar for module in ("numpy.core.multiarray", "numpy._core.multiarray")},
    **{(f"scipy.sparse.{module}", "csc_matrix"): _Sparse for module in ("csc", "_csc")},
}


class _Unpickler(pickle._Unpickler):  # the Python version: the one in C allocates as much as a pickle's memo index says
    dispatch: ClassVar = {
        **pickle._Unpickler.dispatch,
        **{code[0]: _refused for code in (pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET)},
        # The handler of its own allocates as much as a pickle says.
        pickle.BYTEARRAY8[0]: pickle._Unpickler.dispatch[pickle.BINBYTES8[0]],
        pickle.SETITEM[0]: _with_keys(pickle.SETITEM, slice(-2, -1)),
        pickle.SETITEMS[0]: _with_keys(pickle.SETITEMS, slice(0, None, 2)),
        pickle.DICT[0]: _with_keys(pickle.DICT, slice(0, None, 2)),
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it refers to other files")


def _plain(value: Any, done: dict[int, Any]) -> Any:
    """Return `value` with its stand-ins replaced by the data that they represent. done: results by identity, so that an
    object that occurs many times is converted once."""
    if not isinstance(value, _StandIn | dict | list | tuple):
        return value
    if id(value) not in done:
        done[id(value)] = None  # cuts off data that contains itself
        if isinstance(value, _StandIn):
            done[id(value)] = value.plain(done)
        elif isinstance(value, dict):
            done[id(value)] = {key: _plain(item, done) for key, item in value.items()}
        else:
            done[id(value)] = type(value)(_plain(item, done) for item in value)
    return done[id(value)]
