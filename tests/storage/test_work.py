"""Work folders: kept for one recipe, emptied for another, held by one process; SIGTERM noted."""

import errno
import fcntl
import os
import signal

import pytest

from ntop.conventions import DataError
from ntop.storage.work import clear_work, termination_flag, work_folder


def test_pieces_stay_for_the_same_recipe_and_go_with_another(tmp_path):
    with work_folder(tmp_path / "work", recipe={"seed": 1}) as content:
        (content / "piece").write_text("kept")
    with work_folder(tmp_path / "work", recipe={"seed": 1}) as content:
        assert (content / "piece").read_text() == "kept"
    with work_folder(tmp_path / "work", recipe={"seed": 2}) as content:
        assert list(content.iterdir()) == []
        clear_work(tmp_path / "work")
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["lock"]


def test_a_second_holder_is_refused_until_the_first_is_gone(tmp_path):
    with (
        work_folder(tmp_path, recipe={}),
        pytest.raises(DataError, match="already runs"),
        work_folder(tmp_path, recipe={}),
    ):
        pass
    with work_folder(tmp_path, recipe={}):
        pass


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(DataError, match="permissions"),
        work_folder(tmp_path / "file/work", recipe={}),
    ):
        pass


def test_a_file_system_without_locks_is_a_clear_error(tmp_path, monkeypatch):
    def refuse(*_):  # as Lustre does without `-o flock`, and NFS without a lock server
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with (
        pytest.raises(DataError, match=r"cannot lock .*No locks available.*results/work a link"),
        work_folder(tmp_path, recipe={}),
    ):
        pass
    assert not (tmp_path / "recipe.json").exists()


def test_sigterm_sets_the_flag_and_nothing_else():
    before = signal.getsignal(signal.SIGTERM)
    with termination_flag() as terminated:
        assert not terminated()
        os.kill(os.getpid(), signal.SIGTERM)
        assert terminated()
    assert signal.getsignal(signal.SIGTERM) is before
