"""Films of flights: whole or not at all."""

import drawn
import pytest
from matplotlib.animation import FFMpegWriter
from PIL import Image

from jaxscp import plot

SMALL = {"frames": 3, "fps": 4, "dpi": 30.0}


def test_gif(tmp_path):
    mission, solution, _ = drawn.flight()
    file = tmp_path / "flight.GIF"
    assert plot.animate(mission, solution, str(file), **SMALL) == file
    assert list(tmp_path.iterdir()) == [file]
    with Image.open(file) as film:
        assert film.format == "GIF"
        assert film.n_frames == 3
        assert film.info["duration"] == 250
        assert film.size == (270, 150)


@pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="needs ffmpeg")
def test_mp4(tmp_path):
    mission, solution, _ = drawn.flight()
    file = plot.animate(mission, solution, tmp_path / "flight.mp4", **SMALL)
    assert list(tmp_path.iterdir()) == [file]
    assert file.read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("a.avi", {}, "the ending '.avi' names no film format; use one of .gif, .mp4"),
        ("a", {}, "the ending '' names no film format"),
        ("a.mp4", {}, "need ffmpeg, which is not installed; install it or use .gif"),
        ("a.gif", {"frames": 1}, "frames=1: give at least 2"),
        ("a.gif", {"fps": 0}, "fps=0: give at least 1 frame a second"),
        ("a.gif", {"dpi": 0.0}, "dpi=0: give a positive resolution"),
        ("no/a.gif", {}, "the directory .* does not exist; create it"),
    ],
)
def test_refused_in_one_line(tmp_path, monkeypatch, name, changes, message):
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(ValueError, match=message) as raised:
        plot.animate(*drawn.flight()[:2], tmp_path / name, **changes)
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_a_film_that_fails_leaves_the_one_before(tmp_path, monkeypatch):
    mission, solution, _ = drawn.flight()
    file = tmp_path / "flight.gif"
    file.write_bytes(b"before")
    monkeypatch.setattr("matplotlib.animation.PillowWriter.finish", lambda self: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        plot.animate(mission, solution, file, **SMALL)
    assert file.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [file]
