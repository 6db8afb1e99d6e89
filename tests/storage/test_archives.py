"""Tar shards: the bytes back by address, the same tar always, and plain enough for other tools."""

import subprocess
import tarfile

import pytest

from ntop.conventions import DataError
from ntop.storage.archives import Member, member_at, read_content, write_archive

CONTENTS = {"000001_n.image.png": b"", "000000_e.depth.png": b"x" * 513, "a.bin": bytes(range(256))}


@pytest.fixture
def archive(tmp_path):
    for name, content in CONTENTS.items():
        (tmp_path / name).write_bytes(content)
    files = {name: tmp_path / name for name in CONTENTS}
    path = tmp_path / "shard.tar"
    return path, write_archive(files, path=path)


def test_every_member_is_read_by_its_address(archive):
    path, members = archive
    for name, content in CONTENTS.items():
        assert read_content(path.parent / members[name].address) == content


def test_an_address_needs_nothing_but_seek_and_read(archive):
    path, members = archive
    name, offset, size = members["a.bin"].address.rsplit(":", 2)
    with (path.parent / name).open("rb") as stream:
        stream.seek(int(offset))
        assert stream.read(int(size)) == CONTENTS["a.bin"]


def test_other_tools_read_the_archive(archive, tmp_path):
    path, _ = archive
    with tarfile.open(path) as opened:
        assert opened.getnames() == sorted(CONTENTS)
        assert {(m.mtime, m.uid, m.gid, m.mode) for m in opened} == {(0, 0, 0, 0o644)}
    (tmp_path / "out").mkdir()
    subprocess.run(["tar", "xf", str(path), "-C", str(tmp_path / "out")], check=True)
    for name, content in CONTENTS.items():
        assert (tmp_path / "out" / name).read_bytes() == content


def test_the_same_files_give_the_same_bytes_whatever_their_order_and_times(archive, tmp_path):
    path, _ = archive
    for name in CONTENTS:
        (tmp_path / name).touch()
    write_archive({n: tmp_path / n for n in sorted(CONTENTS)}, path=tmp_path / "again.tar")
    assert (tmp_path / "again.tar").read_bytes() == path.read_bytes()


def test_a_cut_archive_says_so_and_how_to_make_it_again(archive):
    path, members = archive
    path.write_bytes(path.read_bytes()[: members["a.bin"].offset + 10])
    with pytest.raises(DataError, match=r"cut off: .* 10 of 256 bytes; .*--forcerun"):
        read_content(path.parent / members["a.bin"].address)


def test_only_addresses_are_taken_for_addresses():
    assert member_at("images/val/000000.tar:512:99") == Member("images/val/000000.tar", 512, 99)
    for path in ("images/a.png", "a.tar", "a.tar:1", "a.tar:1:b", "a.zip:1:2", ":1:2"):
        assert member_at(path) is None


def test_a_missing_file_leaves_no_archive(tmp_path):
    with pytest.raises(DataError, match="cannot write"):
        write_archive({"a": tmp_path / "nothing"}, path=tmp_path / "shard.tar")
    assert list(tmp_path.iterdir()) == []
