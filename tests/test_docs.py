"""Commands, code, links and messages on README and the pages agree with the program."""

import ast
import importlib
import inspect
import math
import os
import re
import shlex
import subprocess
import sys
import types
from pathlib import Path

import pytest

from drake_oa.app.main import _app
from drake_oa.common.messages import HoldReason
from drake_oa.policy.coupling import dead_zone_free_rate
from drake_oa.runs.motion_log import MotionEnd
from drake_oa.safety.maneuvers import ACTIONS
from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.shipped import shipped_scenarios

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += sorted((ROOT / "docs").glob("*/*.md"))
PAGES = [page for page in PAGES if page.parent.name not in ("api", "_build", "tutorials")]


def blocks(kind: str) -> list[tuple[str, str]]:
    """Returns (page, text) of each fenced block of a kind, for example "python"."""
    pattern = re.compile(rf"^```{kind}\n(.*?)^```", re.S | re.M)
    return [(page.name, text) for page in PAGES for text in pattern.findall(page.read_text())]


def commands() -> list[tuple[str, str]]:
    """Returns (page, line) of each line that begins with `drake-oa`."""
    result = []
    for page in PAGES:
        for line in page.read_text().replace("\\\n", " ").splitlines():
            if re.match(r"\s*drake-oa \S", line) and "..." not in line:
                result.append((page.name, line.strip()))
    return result


def test_commands_of_the_pages_are_valid() -> None:
    app = _app()
    assert len(commands()) > 30
    for page, line in commands():
        # A single capital letter is a placeholder of a number.
        words = ["1" if re.fullmatch("[A-Z]", w) else w for w in shlex.split(line, comments=True)]
        try:
            app.parse_args(words[1:], exit_on_error=False, print_error=False)
        except Exception as error:
            pytest.fail(f"{page}: {line}: {error}")


def test_the_environment_is_activated_before_the_first_command() -> None:
    for page in (ROOT / "README.md", ROOT / "docs" / "start.md"):
        before, command, _ = page.read_text().partition("drake-oa play")
        assert command
        assert ". .venv/bin/activate" in before


def test_imports_of_the_pages_succeed() -> None:
    assert blocks("python")
    for page, block in blocks("python"):
        for node in ast.walk(ast.parse(block, page)):
            if isinstance(node, ast.ImportFrom) and node.module:
                module = importlib.import_module(node.module)
                missing = [name.name for name in node.names if not hasattr(module, name.name)]
                assert missing == [], page


def test_examples_of_the_pages_have_the_printed_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    guides = (f"docs/guides/{name}.md" for name in ("customize", "scenario"))
    pages = [ROOT / "README.md", *map(ROOT.joinpath, guides)]
    for page in (*pages, *sorted((ROOT / "docs" / "theory").glob("*.md"))):
        for example, output in re.findall(
            r"^```python\n(.*?)^```\n\n```text\n(.*?)^```", page.read_text(), re.S | re.M
        ):
            exec(example, {})
            assert capsys.readouterr().out == output, page.name


def test_avoidance_rate_is_the_formula_of_the_theory_page() -> None:
    formula = r"\alpha \operatorname{sign}(\theta) \, e^{-\theta^2 / \psi^2} \, e^{-\kappa d^2}"
    assert formula in (ROOT / "docs" / "theory" / "coupling.md").read_text()
    for theta, d, alpha, psi, kappa in ((0.0, 0.1, 50.0, 0.5, 2.0), (-0.7, 0.3, 9.0, 0.4, 5.0)):
        sign = -1.0 if theta < 0.0 else 1.0
        expected = alpha * sign * math.exp(-(theta**2) / psi**2) * math.exp(-kappa * d**2)
        assert dead_zone_free_rate(theta, d, alpha, psi, kappa) == pytest.approx(expected)


def test_linked_objects_of_the_package_exist() -> None:
    for page in PAGES:
        for name in re.findall(r"\{py:\w+\}`[^`]*?~?(drake_oa[\w.]*)>?`", page.read_text()):
            package, *rest = name.split(".")
            subject: object = importlib.import_module(package)
            for part in rest:
                if not hasattr(subject, part):
                    assert isinstance(subject, types.ModuleType), f"{page.name}: {name}"
                    importlib.import_module(f"{subject.__name__}.{part}")
                subject = getattr(subject, part)


def test_scenario_blocks_of_the_pages_are_valid() -> None:
    assert blocks("yaml")
    whole = shipped_scenarios()["two_cameras"].read_text()
    around = re.sub(r"^perception:.*\n(?:[ #].*\n)*", "", whole, flags=re.M)
    for _, block in blocks("yaml"):
        assert block.startswith("perception:")
        parse_scenario(around + block)


def test_linked_files_exist() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text()):
            if "://" not in target and not target.startswith("mailto:"):
                # The build of the site generates these two.
                is_generated = target.endswith(("gallery.md", "api/index.rst"))
                assert is_generated or (page.parent / target).exists(), f"{page.name}: {target}"


MESSAGES = {
    "common": "config files signal_builder",
    "control": "joint_inverse_dynamics",
    "descriptor": "descriptor",
    "hardware": "command_streamer franka_arm hardware_station panda_station robot_link",
    "inference": "weights_file",
    "perception": "depth_perception ground_truth_perception recordings segmentation",
    "planning": "motion_search motion_verifier perceived_scene",
    "robot": "plant",
    "route": "cost_ring_selector cost_rings",
    "runs": "motion_log replay simulation",
    "safety": "motion_guard supervision",
    "scenario": "demonstration end_poses loading obstacles perception scenario sources task",
    "world": "bag_images depth_messages live_camera station world_model",
}
"""Modules with messages for users, by package."""
NO_MESSAGES = {"context of the robot's model"}
"""Strings of these modules that are not printed."""


def message_parts(module: str) -> set[str]:
    """Returns the constant parts of a module's messages: strings of three words and more."""
    tree = ast.parse(inspect.getsource(importlib.import_module(module)))
    docs = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    texts = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in docs
    ]
    placeholder = r"(?:t=)?%[.\d]*[sdf](?: s:)?|\{\}"
    parts = {part.strip(" :;,('") for text in texts for part in re.split(placeholder, text)}
    # Lists of names of one and two letters, such as columns of a file, are no messages.
    return {part for part in parts if re.search(r"(?s)(?=.*\w{3}).*\w \w+ \w", part)} - NO_MESSAGES


def test_troubleshooting_explains_each_message() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    for package, names in MESSAGES.items():
        for name in names.split():
            parts = message_parts(f"drake_oa.{package}.{name}")
            assert [part for part in parts if part not in page] == []
    for value in (*HoldReason, *MotionEnd, *ACTIONS):
        assert value in page


def test_outputs_of_result_pages_are_inserted(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```sh\npython -m this\n```\n\nNot measured on this source yet.\n\nEnd.\n")
    program = [sys.executable, ROOT / "docs" / "update_results.py", page, "--folder", tmp_path]
    for _ in range(2):
        subprocess.run(program, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
        assert page.read_text().count("Explicit is better than implicit.\n") == 1
        assert "source digest" in page.read_text()
        assert "Not measured" not in page.read_text()
        assert page.read_text().endswith("\n\nEnd.\n")
