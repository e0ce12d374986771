"""Progress where stderr is no terminal: a line a minute, with the rate of what this run has done."""

import pytest

from synth.progress import progress


@pytest.mark.parametrize(
    ("pace", "lines"),
    [
        (10.0, ["8 of 12, 10.0 s each, about 40.0 s left"]),
        (0.1, []),
        (70.0, ["3 of 12", *(f"{done} of 12, 70.0 s each, about " for done in range(4, 12))]),
    ],
)
def test_a_line_a_minute_where_stderr_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, pace: float, lines: list[str]
) -> None:
    """Two of twelve were there before; each of the others takes `pace` seconds."""
    clock = [0.0]
    monkeypatch.setattr("synth.progress.time.monotonic", lambda: clock[0])
    with progress("generate: pairs", 12) as advance:
        for done in range(3, 13):
            clock[0] += pace
            advance(done, 12)
    out, err = capsys.readouterr()
    assert out == ""
    said = err.splitlines()
    assert len(said) == len(lines)
    for line, start in zip(said, lines, strict=True):
        assert line.startswith(f"synth: generate: pairs: {start}")
