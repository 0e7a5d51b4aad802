"""The source distribution holds what the repository holds: tests, docs, `./dev`."""

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
NOT_IN_IT = {".gitignore"}


@pytest.mark.skipif(not (REPOSITORY / ".git").exists(), reason="no git checkout to compare with")
def test_the_source_distribution_has_every_file_of_the_repository(tmp_path: Path) -> None:
    listing = subprocess.run(
        ["git", "ls-files", "-z"], cwd=REPOSITORY, check=True, capture_output=True, text=True
    )
    files = {name for name in listing.stdout.split("\0") if (REPOSITORY / name).is_file()}
    copy = tmp_path / "copy"
    for name in files:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / name, copy / name)
    command = [sys.executable, "setup.py", "-q", "sdist", "--dist-dir", str(tmp_path)]
    subprocess.run(command, cwd=copy, check=True, capture_output=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as archived:
        packed = {name.partition("/")[2] for name in archived.getnames()}
    assert files - packed == NOT_IN_IT
