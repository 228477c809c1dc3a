"""One writer at a time, also where several users share a folder."""

import os
import tempfile
import warnings
from pathlib import Path

import pytest

from navrep_data.errors import DatasetLockedError, FolderNotWritableError
from navrep_data.shards.lock import LOCK_FILE, writer_lock

GROUP, ONE, OTHER = 54321, 12345, 23456
needs_root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can be somebody else"
)


def test_one_writer_at_a_time(tmp_path):
    told = pytest.raises(DatasetLockedError, match="Another process is writing")
    with writer_lock(tmp_path), told, writer_lock(tmp_path):
        pass
    with writer_lock(tmp_path):
        pass


@pytest.mark.skipif(os.name == "nt", reason="Windows has no groups of this kind")
@pytest.mark.parametrize(("folder", "lock"), [(0o755, 0o644), (0o2775, 0o664), (0o777, 0o666), (0o700, 0o644)])
def test_who_may_write_the_folder_may_lock_it(tmp_path, folder, lock):
    tmp_path.chmod(folder)
    with writer_lock(tmp_path):
        assert (tmp_path / LOCK_FILE).stat().st_mode & 0o777 == lock


def as_user(user, folder):
    """Lock the folder as another user of the group; return what went wrong."""
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads: the child does next to nothing
        child = os.fork()
    if child == 0:
        said = ""
        try:
            os.setgroups([])
            os.setgid(GROUP)
            os.setuid(user)
            with writer_lock(folder):
                pass
        except BaseException as error:
            said = f"{type(error).__name__}: {error}"
        os.write(write, said.encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(write)
    with os.fdopen(read) as told:
        return told.read()


@pytest.fixture
def shared_folder():
    with tempfile.TemporaryDirectory() as place:  # pytest's own folders are closed to others
        os.chmod(place, 0o711)
        folder = Path(place) / "d"
        folder.mkdir()
        os.chown(folder, ONE, GROUP)
        yield folder


@pytest.mark.slow
@needs_root
@pytest.mark.parametrize("mode", [0o2775, 0o775])
def test_a_group_goes_on_with_each_others_datasets(shared_folder, mode):
    shared_folder.chmod(mode)
    assert as_user(ONE, shared_folder) == ""
    assert (shared_folder / LOCK_FILE).stat().st_uid == ONE
    assert as_user(OTHER, shared_folder) == ""


@needs_root
def test_a_lock_file_of_another_user_is_told(shared_folder):
    shared_folder.chmod(0o2775)
    assert as_user(ONE, shared_folder) == ""
    (shared_folder / LOCK_FILE).chmod(0o644)  # as older versions made it
    said = as_user(OTHER, shared_folder)
    assert said.startswith(FolderNotWritableError.__name__)
    assert f"{LOCK_FILE} belongs to user {ONE} and cannot be opened by this one: Permission denied" in said
    assert "chmod g+w" in said
