from wlm.errors import WlmError, one_line


def test_lines_are_joined_and_cut():
    assert one_line("a\n  b\r\n\nc ") == "a b c"
    assert one_line("x" * 50, limit=10) == "xxxxxxx..."
    assert one_line("x" * 10, limit=10) == "x" * 10


def test_an_error_is_one_line():
    assert str(WlmError("first\nsecond")) == "first second"
