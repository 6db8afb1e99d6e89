import re
from concurrent.futures import ThreadPoolExecutor

import pytest

from ntop.storage import pace
from ntop.storage.pace import Pace, duration, paced


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests set, in seconds."""
    now = [100.0]
    monkeypatch.setattr(pace.time, "monotonic", lambda: now[0])
    return now


def test_lines_say_how_much_how_fast_and_how_long(clock, capsys):
    told = Pace("mask", total=400, unit="frames")
    for _ in range(12):
        clock[0] += 2
        told.step()
    lines = capsys.readouterr().err.splitlines()
    # every third step: a line in five seconds at most
    assert lines == [
        "mask: 3/400 frames, 0.500 frames/s, 13.2 min left",
        "mask: 6/400 frames, 0.500 frames/s, 13.1 min left",
        "mask: 9/400 frames, 0.500 frames/s, 13.0 min left",
        "mask: 12/400 frames, 0.500 frames/s, 12.9 min left",
    ]


def test_a_short_loop_says_one_line_at_its_end(clock, capsys):
    items = paced("abcd", what="annotate", total=4, unit="images")
    for _ in items:
        clock[0] += 0.01
    assert capsys.readouterr().err == "annotate: 4/4 images, 100.0 images/s, 0 s left\n"
    assert list(paced([], what="annotate", total=0, unit="images")) == []
    assert capsys.readouterr().err == ""


def test_steps_from_many_threads_are_all_counted(capsys):
    told = Pace("mask", total=400, unit="looks")
    with ThreadPoolExecutor(8) as pool:
        for _ in range(400):
            pool.submit(told.step)
    assert re.search(r"^mask: 400/400 looks", capsys.readouterr().err, re.MULTILINE)


def test_an_item_counts_once_it_is_done(clock, capsys):
    items = paced([1, 2], what="w", total=2, unit="u")
    next(items)
    clock[0] += 10
    assert capsys.readouterr().err == ""
    next(items)
    assert capsys.readouterr().err.startswith("w: 1/2 u, 0.100 u/s, 10 s left")


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0, "0 s"), (99, "99 s"), (100, "1.7 min"), (5000, "83.3 min"), (6000, "1.7 h")],
)
def test_durations_for_people(seconds, words):
    assert duration(seconds) == words
