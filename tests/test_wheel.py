"""Contents of the wheel, and the installed command without the checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = {"drake_oa": "drake_oa", "diagrams": "drake_oa/diagrams", "models": "drake_oa/models"}


def package_files() -> set[str]:
    """Returns the paths in the wheel of all files of the packages."""
    return {
        f"{inside}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, inside in SOURCES.items()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def quiet_run(*command: str, **options: object) -> subprocess.CompletedProcess[str]:
    """Runs a command; its output is in the message of a failed assertion."""
    answer = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert answer.returncode == 0, f"{command}:\n{answer.stdout}\n{answer.stderr}"
    return answer


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of the wheel, built from a copy, so that the checkout does not change."""
    tree = tmp_path_factory.mktemp("source")
    for folder in SOURCES:
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, tree / folder, ignore=ignore)
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, tree)
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation"]
    quiet_run(*build, "--outdir", str(folder), str(tree))
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def names(wheel: Path) -> set[str]:
    """Paths of the files in the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which only the wheel is installed."""
    folder = tmp_path_factory.mktemp("site")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index"]
    quiet_run(*install, "--target", str(folder), str(wheel))
    return folder


def installed(site: Path, folder: Path, *arguments: str, **environment: str) -> str:
    """Runs the installed `drake-oa` in a folder, with precedence over other installations."""
    path = {"PYTHONPATH": str(site)}
    command = [sys.executable, str(site / "bin" / "drake-oa"), *arguments]
    return quiet_run(*command, cwd=folder, env=os.environ | path | environment).stdout


def test_wheel_contains_exactly_the_package(names: set[str]) -> None:
    assert {name for name in names if ".dist-info/" not in name} == package_files()
    assert len({name.partition("/")[0] for name in names}) == 2


def test_installed_command_uses_the_wheel(site: Path, tmp_path: Path) -> None:
    for line in installed(site, tmp_path, "scenarios", "--files").splitlines():
        assert Path(line.split(maxsplit=1)[1]).is_relative_to(site)


@pytest.mark.slow
def test_installed_command_runs_without_writable_folders(site: Path, tmp_path: Path) -> None:
    frozen = tmp_path / "site"
    shutil.copytree(site, frozen, ignore=shutil.ignore_patterns("__pycache__"))
    # A file, so that not even root can write into it.
    (frozen / "drake_oa" / "__pycache__").touch()
    nowhere = {"HOME": os.devnull, "XDG_CACHE_HOME": os.devnull, "NUMBA_CACHE_DIR": ""}
    assert "tabletop_box" in installed(frozen, tmp_path, "scenarios", **nowhere)


@pytest.mark.slow
def test_wheel_with_compiled_kernels_compiles_nothing(tmp_path: Path) -> None:
    """The new environment has the other packages of the present one, but not the checkout."""
    stamp = f"{sys.prefix}/.installed-dev"
    folders = (f"VENV={sys.prefix}", f"DIST={tmp_path}", f"WHEEL={tmp_path / 'source'}")
    quiet_run("make", "-C", str(ROOT), "wheel", "-o", stamp, *folders)
    (built,) = tmp_path.glob("*.whl")
    assert not built.name.endswith("-any.whl")
    venv.create(tmp_path / "env")
    (packages,) = (tmp_path / "env").glob("lib/python*/site-packages")
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index"]
    quiet_run(*install, "--target", str(packages), str(built))
    (empty := tmp_path / "empty").mkdir()
    answer = quiet_run(
        str(tmp_path / "env" / "bin" / "python"),
        *("-m", "drake_oa.app.main", "run", "tabletop_box"),
        cwd=empty,
        env=os.environ | {"NUMBA_DEBUG_CACHE": "1", "PYTHONPATH": ""},
    )
    loaded = [line for line in answer.stdout.splitlines() if "data loaded from" in line]
    assert len(loaded) > 15
    assert all(str(packages) in line for line in loaded)
    assert "data saved to" not in answer.stdout
    assert "compiling" not in answer.stderr
    assert ["nominal", "avoiding"] in [line.split() for line in answer.stdout.splitlines()]
    assert [path.name for path in empty.iterdir()] == ["drake_oa_runs"]
