"""Compiled kernels always have a place, and who waits for them is told so."""

import importlib.util
import os
import shutil
from pathlib import Path
from types import ModuleType

import numba
import pytest

from drake_oa.app.main import main
from drake_oa.common import numba_tools
from drake_oa.common.numba_tools import (
    announced_compilation,
    pin_processor_target,
    provide_kernel_cache,
)


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    # Set first, so that what the function sets is undone afterwards.
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    monkeypatch.setenv("DRAKE_OA_KERNELS_FOR_NOW", "")
    monkeypatch.delenv("DRAKE_OA_KERNELS_FOR_NOW")


def read_only(package: Path) -> Path:
    """A package beside whose source nothing can be kept, not even by root."""
    (package / "__pycache__").touch()
    return package


def test_beside_the_source_or_in_the_users_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert provide_kernel_cache(tmp_path) is None
    assert not os.environ["NUMBA_CACHE_DIR"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert provide_kernel_cache(read_only(tmp_path)) is None
    assert not os.environ["NUMBA_CACHE_DIR"]


def test_kernels_whose_callees_change_are_removed(tmp_path: Path) -> None:
    package = tmp_path / "package"
    (package / "sub").mkdir(parents=True)
    texts = {
        "callee": "@compiled\ndef f(): ...",
        "sub/caller": "from package.callee import f\n@compiled\ndef g(): ...",
        "sub/other": "@leaf\ndef h(): ...",
    }
    compiled = {}
    for name, text in texts.items():
        file = package / f"{name}.py"
        file.write_text(text)
        compiled[name] = file.parent / "__pycache__" / f"{file.stem}.f-1.py311.nbi"
        compiled[name].parent.mkdir(exist_ok=True)
    assert provide_kernel_cache(package) is None

    def left() -> list[str]:
        return [name for name, file in compiled.items() if file.exists()]

    for file in compiled.values():
        file.touch()
    assert provide_kernel_cache(package) is None
    assert left() == list(texts)
    (package / "callee.py").write_text(texts["callee"] + "  # changed")
    assert provide_kernel_cache(package) is None
    assert left() == ["sub/other"]


def test_in_a_temporary_folder_where_nothing_else_can_be_written(tmp_path: Path) -> None:
    folder = provide_kernel_cache(read_only(tmp_path))
    assert folder is not None
    assert os.environ["NUMBA_CACHE_DIR"] == folder.name
    assert os.environ["DRAKE_OA_KERNELS_FOR_NOW"] == folder.name
    assert Path(folder.name).stat().st_mode & 0o777 == 0o700
    folder.cleanup()


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_kernels_of_a_read_only_package_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package, cache = tmp_path / "package", tmp_path / "cache"
    package.mkdir()
    source = package / "compiled_kernels.py"
    source.write_text(SOURCE)
    assert imported(source).thrice(2) == 6
    beside = package / "__pycache__"
    assert list(beside.glob("*.nbi"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(numba_tools, "is_writable", lambda folder: folder != beside)
    (cache / "numba").mkdir(parents=True)
    assert provide_kernel_cache(package) is None
    shutil.rmtree(beside)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(cache / "numba"))
    with announced_compilation():
        assert imported(source).thrice(2) == 6
    assert capsys.readouterr().err == ""
    assert provide_kernel_cache(package) is None  # A second time there is nothing to do.


def test_what_the_user_chose_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/mine")
    assert provide_kernel_cache(read_only(tmp_path)) is None
    assert os.environ["NUMBA_CACHE_DIR"] == "/mine"


SOURCE = """
from numba import njit

@njit(cache=True)
def twice(x):
    return 2 * x

@njit(cache=True)
def thrice(x):
    return x + twice(x)
"""


def imported(source: Path) -> ModuleType:
    """The module of a file, anew."""
    spec = importlib.util.spec_from_file_location("drake_oa.compiled_kernels", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_compilation_is_announced_once_and_not_when_it_is_cached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "compiled_kernels.py"
    source.write_text(SOURCE)
    with announced_compilation("1 min"):
        # Two kernels, one inside the other.
        assert imported(source).thrice(2) == 6
    assert capsys.readouterr().err == "compiling kernels, once (about 1 min) ...\n"
    with announced_compilation("1 min"):
        assert imported(source).thrice(2) == 6
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("drake_oa.common.numba_tools._WORTH_TELLING", 0.0)
    source.write_text(SOURCE.replace("2 * x", "10 * x"))
    with announced_compilation():
        assert imported(source).thrice(2) == 22
    announced = capsys.readouterr().err
    assert announced.startswith("compiling kernels, once ...")
    assert "thrice: " in announced
    assert imported(source).thrice(2.0) == 22.0
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_the_commands_announce_compilation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "compiled_kernels.py"
    source.write_text(SOURCE)
    from drake_oa.diagrams import avoidance

    build = avoidance.build_avoidance

    def compiling(scenario: object) -> object:
        imported(source).twice(2)
        return build(scenario)

    monkeypatch.setattr(avoidance, "build_avoidance", compiling)
    assert main(["graph", "free_space", "--dot"]) == 0
    assert "compiling kernels" in capsys.readouterr().err


def test_kernels_are_compiled_for_one_processor_on_all_that_have_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):
        # Set first, so that what the function sets is undone afterwards.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    for older in ("flags\t\t: fpu sse4_2 avx\n", "Features\t: fp asimd\n"):
        cpuinfo.write_text("processor : 0\n" + older)
        pin_processor_target(cpuinfo)
        assert "NUMBA_CPU_NAME" not in os.environ
    pin_processor_target(tmp_path / "missing")
    assert "NUMBA_CPU_NAME" not in os.environ
    v3 = "fma movbe xsave avx f16c abm bmi1 avx2 bmi2 avx512f"
    cpuinfo.write_text(f"flags\t\t: {v3}\nbugs\t: none\n")
    pin_processor_target(cpuinfo)
    assert os.environ["NUMBA_CPU_NAME"] == "x86-64-v3"
    assert os.environ["NUMBA_CPU_FEATURES"] == ""
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    pin_processor_target(cpuinfo)
    assert os.environ["NUMBA_CPU_NAME"] == "generic"
