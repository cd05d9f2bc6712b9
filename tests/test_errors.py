import pytest

from hnerf.errors import InputError, one_line, printable

CUDA = "CUDA error: an assert\nCUDA kernel errors might be reported later.\nCompile with `TORCH_USE_CUDA_DSA`.\n"
TRACE = 'rank 0 ended with exit code 1\nTraceback:\n  File "run.py", line 3, in train\n    train()\n    ^^^^^^^\n'
SETTINGS = "1 validation error for Settings\nsteps\n  Field required\n    For further information visit a page"


def test_a_message_is_one_line_without_control_characters() -> None:
    assert str(InputError("a.toml: camera \x1b[2J\nb: 張 é")) == "a.toml: camera \\x1b[2J b: 張 é"


def test_long_messages_are_shortened() -> None:
    shown = printable("begin" + "x" * 10**6 + "end")
    assert len(shown) < 2100 and shown.startswith("begin") and shown.endswith("end")


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (CUDA, "CUDA error: an assert"),
        (f"{TRACE}RuntimeError: {CUDA}", "RuntimeError: CUDA error: an assert"),
        (SETTINGS, "1 validation error for Settings"),
        ("", "ValueError"),
    ],
)
def test_one_line_of_a_message_is_the_one_that_says_why(message: str, line: str) -> None:
    assert one_line(ValueError(message)) == line
