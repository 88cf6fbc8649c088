"""The built wheel: everything travels with it, and it flies from anywhere, whatever folders lie around."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout, built from a copy, so that nothing of an older build gets into it."""
    out, source = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("source")
    for name in ("mavquad", "sitl", "tools"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--no-build-isolation", "--wheel-dir", str(out)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(source)], check=True, capture_output=True)
    (found,) = out.glob("*.whl")
    return found


def test_every_source_and_data_file_travels_with_the_wheel(wheel):
    inside = set(zipfile.ZipFile(wheel).namelist())
    for package in ("mavquad", "sitl", "tools"):
        files = {p.relative_to(ROOT).as_posix() for p in (ROOT / package).rglob("*") if p.is_file()}
        missing = {name for name in files if "__pycache__" not in name} - inside
        assert not missing
    assert not [name for name in inside if name.startswith("tests/")]


@pytest.mark.slow
def test_it_flies_from_a_folder_that_has_a_tools_folder_of_its_own(wheel, tmp_path):
    home = tmp_path / "venv"
    venv.create(home, with_pip=False, symlinks=True)
    site = Path(sysconfig.get_path("purelib", "venv", {"base": str(home), "platbase": str(home)}))
    zipfile.ZipFile(wheel).extractall(site)
    (site / "dependencies.pth").write_text(
        sysconfig.get_path("purelib") + "\n"
    )  # this environment's, without its own .pth files
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools" / "__init__.py").write_text("raise SystemExit('not these tools')\n")
    entry = home / "bin" / "mavquad"
    entry.write_text(f"#!{home / 'bin' / 'python'}\nimport sys\nfrom tools.__main__ import main\nsys.exit(main())\n")
    entry.chmod(0o755)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    command = [str(entry), "fly", "circle", "--seed", "7", "--run", "flown", "--json"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["ok"]
    assert summary["rmse_m"]["position"] <= 0.15
    assert (tmp_path / "flown" / "report.html").stat().st_size < 8e6
