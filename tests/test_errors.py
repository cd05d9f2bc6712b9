from hnerf.errors import InputError, printable


def test_a_message_is_one_line_without_control_characters() -> None:
    assert str(InputError("a.toml: camera \x1b[2J\nb: 張 é")) == "a.toml: camera \\x1b[2J b: 張 é"


def test_long_messages_are_shortened() -> None:
    shown = printable("begin" + "x" * 10**6 + "end")
    assert len(shown) < 2100 and shown.startswith("begin") and shown.endswith("end")
