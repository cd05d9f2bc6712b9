"""Pickles are read as plain data, and nothing in them is executed."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from hnerf.capture.safe_pickle import read_pickle, read_pickled_npy
from hnerf.errors import InputError

DATA: dict[str, Any] = {
    "K": [np.arange(9.0).reshape(3, 3), np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))],
    "ims": np.array([{"ims": ["a", "b"]}, {"ims": []}], object),
    "count": np.float64(2.5),
    "kintree": np.array([[2**32 - 1, 0]], np.uint32),
    "big": np.array([1.5, 2], ">f4"),
    "flags": np.array([True, False]),
    "turned": np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
    "none": np.zeros((0, 3)),
}


class Bomb:
    """An object whose pickle leaves a trace if anyone loads it."""

    def __reduce__(self) -> tuple:
        return os.system, ("touch pickle-was-loaded",)


def dumped(path: Path, value: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(value, protocol))
    return path


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_plain_data_is_read(tmp_path: Path, protocol: int) -> None:
    found = read_pickle(dumped(tmp_path / "a.pkl", DATA, protocol))
    assert np.array_equal(found["K"][0], DATA["K"][0]) and np.array_equal(found["K"][1], DATA["K"][1])
    assert found["ims"].shape == (2,) and found["ims"][0] == {"ims": ["a", "b"]}
    assert found["count"] == 2.5 and found["big"].tolist() == [1.5, 2] and found["flags"].tolist() == [True, False]
    assert np.array_equal(found["turned"], DATA["turned"]) and found["none"].shape == (0, 3)
    assert found["kintree"].dtype == np.uint32 and found["kintree"].tolist() == [[4294967295, 0]]


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_sparse_matrices_are_read(tmp_path: Path, protocol: int) -> None:
    dense = np.array([[0.0, 2, 0], [1, 0, 0.5]])
    found = read_pickle(dumped(tmp_path / "a.pkl", {"J": scipy.sparse.csc_matrix(dense)}, protocol))
    assert np.array_equal(found["J"].toarray(), dense)


def test_arrays_pickled_by_python_2_are_read(tmp_path: Path) -> None:
    """Under Python 2, numpy refers to numpy.core.multiarray and pickles bytes as text. 2.0 is 40 00 00 00 00 00 00 00,
    big endian."""
    (tmp_path / "a.pkl").write_bytes(
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
        b"(I1\n(I1\ntcnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\n"
        b"S'\\x00\\x00\\x00\\x00\\x00\\x00\\x00@'\ntb."
    )
    assert read_pickle(tmp_path / "a.pkl").tolist() == [2.0]


def test_arrays_that_numpy_1_pickled_by_protocol_5_are_read(tmp_path: Path) -> None:
    data = pickle.dumps(np.ones((2, 3)), 5)
    assert data.count(b"\x13numpy._core.numeric") == 1  # the length of the name before it
    unframed = data[:2] + data[11:]  # without the length of the whole
    (tmp_path / "a.pkl").write_bytes(unframed.replace(b"\x13numpy._core", b"\x12numpy.core"))
    assert np.array_equal(read_pickle(tmp_path / "a.pkl"), np.ones((2, 3)))


def test_chumpy_arrays_are_read_as_plain_arrays(tmp_path: Path) -> None:
    """The pickle is built as chumpy's are: the class, then its attributes, of which x is the value. chumpy is not
    needed."""
    numbers = pickle.dumps(np.array([3.0, 4.0]), 2)[2:-1]  # without its PROTO and STOP
    stored = (
        b"ccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nobject\nNtR(dS'x'\n" + numbers + b"sS'want'\nNsb."
    )
    (tmp_path / "a.pkl").write_bytes(b"\x80\x02" + stored)
    assert read_pickle(tmp_path / "a.pkl").tolist() == [3.0, 4.0]
    (tmp_path / "a.pkl").write_bytes(b"\x80\x02" + stored.replace(b"chumpy.ch\nCh", b"chumpy.reordering\nSelect"))
    with pytest.raises(InputError, match=r"a\.pkl: .* names chumpy.reordering.Select\); convert it to \.npz"):
        read_pickle(tmp_path / "a.pkl")


def test_npy_files_of_one_dictionary_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", {"poses": np.ones((1, 72))}, allow_pickle=True)  # type: ignore[arg-type]
    assert read_pickled_npy(tmp_path / "a.npy")["poses"].shape == (1, 72)
    np.save(tmp_path / "b.npy", np.ones(3))
    with pytest.raises(InputError, match=r"b\.npy: holds no dictionary"):
        read_pickled_npy(tmp_path / "b.npy")


def _of_a_terabyte() -> bytes:
    """Return a pickled array that declares 10^12 numbers and has two."""
    stored = pickle.dumps(np.ones(2), 0)
    assert stored.count(b"I2\n") == 1
    return stored.replace(b"I2\n", b"I1000000000000\n")


SHARED = b"2\x86" * 60  # 60 times, replaces the top of the stack by a tuple of it and itself

BAD = {
    "a call": pickle.dumps({"cams": Bomb()}),
    "a call in an array": pickle.dumps(np.array([Bomb()], object)),
    "another function of an allowed module": b"cnumpy\nfromfile\n(S'/etc/passwd'\ntR.",
    "a call through an allowed function": b"cnumpy.core.multiarray\n_reconstruct\n(c__builtin__\nset\n(I0\ntS'b'\ntR.",
    "a set": pickle.dumps({1, 2}, 4),
    "a frozen set": pickle.dumps(frozenset({1, 2}), 4),
    "a key that is a nested tuple": b"\x80\x02})" + SHARED + b"K\x01s.",
    "keys that are nested tuples": b"\x80\x02}()" + SHARED + b"K\x01K\x02K\x03u.",
    "a nested tuple as key of a whole dictionary": b"()" + SHARED + b"K\x01d.",
    "a nested tuple as a type": b"\x80\x02cnumpy\ndtype\n)" + SHARED + b"\x85R.",
    "an array that declares more than it holds": _of_a_terabyte(),
    "bytes that declare more than they hold": b"\x80\x05\x96" + (10**12).to_bytes(8, "little") + b".",
    "a buffer that declares more than it holds": pickle.dumps(np.ones(2), 5).replace(b"K\x02\x85", b"K\x09\x85"),
    "cut short": pickle.dumps(DATA)[:300],
    "deeply nested": b"(" * 5000 + b"l" * 5000 + b".",
    "text": b"hello",
    "nothing": b"",
}


@pytest.mark.parametrize("case", BAD)
def test_anything_but_plain_data_is_refused(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.pkl").write_bytes(BAD[case])
    with pytest.raises(InputError, match=r"a\.pkl: not a pickle of plain data"):
        read_pickle(tmp_path / "a.pkl")
    assert not (tmp_path / "pickle-was-loaded").exists()


def test_a_set_in_an_old_protocol_is_read_without_hashing(tmp_path: Path) -> None:
    (tmp_path / "a.pkl").write_bytes(b"\x80\x02}U\x01ac__builtin__\nset\n](" + b")" + SHARED + b"e\x85RsU\x01bK\x02s.")
    with pytest.raises(InputError, match="more than 10000000 items"):
        read_pickle(tmp_path / "a.pkl")
    assert read_pickle(dumped(tmp_path / "b.pkl", {"a": {5}, "b": 2}, 2)) == {"a": [5], "b": 2}


def nested_twice(levels: int) -> list[Any]:
    """Return nested lists, each of which holds the next twice: 2^levels leaves."""
    nested: list[Any] = [np.ones(1)]
    for _ in range(levels):
        nested = [nested, nested]
    return nested


def test_an_object_that_a_pickle_holds_twice_is_made_once(tmp_path: Path) -> None:
    found = read_pickle(dumped(tmp_path / "a.pkl", nested_twice(20)))
    assert found[0] is found[1]


def test_nested_lists_too_large_for_an_array_are_refused(tmp_path: Path) -> None:
    """An array of them would hold 10^12 numbers."""
    with pytest.raises(InputError, match="more than 10000000 items"):
        read_pickle(dumped(tmp_path / "a.pkl", {"camera_f": nested_twice(40)}))


@pytest.mark.parametrize(
    "header", ["{'descr': '|O', 'fortran_order': False, 'shape': ((", "{'descr': {}, 'x'", "[" * 900]
)
def test_a_damaged_header_of_an_npy_file_is_refused(header: str, tmp_path: Path) -> None:
    text = f"{header:<117}\n".encode()
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text)
    with pytest.raises(InputError, match=r"a\.npy: is no \.npy file"):
        read_pickled_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("payload", ["text", ["a"], {"a": 1}, np.array(["a", "b"], object)])
def test_an_npy_file_of_anything_but_one_object_is_refused(payload: object, tmp_path: Path) -> None:
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    header += b" " * (117 - len(header)) + b"\n"
    magic = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
    (tmp_path / "a.npy").write_bytes(magic + header + pickle.dumps(payload))
    with pytest.raises(InputError, match="holds no dictionary"):
        read_pickled_npy(tmp_path / "a.npy")


def test_characters_that_unicode_does_not_have_are_refused(tmp_path: Path) -> None:
    data = pickle.dumps(np.array(["abc", "d"]), 2)
    assert data.count(b"c\x00\x00\x00") == 1
    (tmp_path / "a.pkl").write_bytes(data.replace(b"c\x00\x00\x00", b"c\x00\x00\x7f"))
    with pytest.raises(InputError, match="characters that Unicode does not have"):
        read_pickle(tmp_path / "a.pkl")


def test_a_huge_memo_index_allocates_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.pkl").write_bytes(b"\x80\x02]r\xff\xff\xff\x7f.")
    assert read_pickle(tmp_path / "a.pkl") == []
