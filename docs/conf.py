"""Sphinx configuration for `make docs`; `_write_api` generates the API pages from the modules."""

import importlib
import inspect
import pkgutil
from importlib.metadata import version as installed_version
from pathlib import Path

import yaml
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

import drake_oa
from drake_oa.scenario.shipped import description, shipped_scenarios

project = "drake_oa"
author = "The drake_oa maintainers"
project_copyright = "2026, the drake_oa maintainers"
version = release = installed_version("drake_oa")
# myst_nb includes myst_parser, and runs the tutorials.
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath"]
myst_update_mathjax = False
# KaTeX 0.16.47 (npm) and its fonts are in docs/_static/katex, so that formulas need no network;
# sphinx.ext.mathjax loads it on pages with formulas, and render.js renders them.
html_static_path = ["_static"]
mathjax_path = "katex/katex.min.js"
mathjax_options = {"defer": "defer"}
html_js_files = [("katex/render.js", {"defer": "defer"})]
html_css_files = ["katex/katex.min.css", "formulas.css"]
myst_heading_anchors = 4
# Tutorials run whenever their page is read, each in its own folder, and an error in a cell fails
# the build. The first run on a machine compiles the kernels.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 900
nb_execution_raise_on_error = True
default_role = "code"
# Indented blocks of docstrings are tables and texts; code in pages names its language.
highlight_language = "text"
html_theme = "furo"
html_title = "drake_oa"
autoclass_content = "both"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Keys", "params_style")]
exclude_patterns = ["_build", "jupyter_execute"]
# Code that cannot be parsed is not highlighted, classes of Drake are not linked, and headings may
# skip levels.
suppress_warnings = ["misc.highlighting_failure", "myst.header", "ref.python"]

_HERE = Path(__file__).parent


class PydrakeSystem(Directive):
    """Directive `pydrake_system` of Drake: the ports of a system, as two lines of names."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Returns the paragraphs."""
        ports = yaml.safe_load("\n".join(self.content)) or {}
        paragraphs: list[nodes.Node] = []
        for key, title in (("input_ports", "Input ports"), ("output_ports", "Output ports")):
            names = [str(name) for name in ports.get(key) or ()]
            line = nodes.paragraph()
            line += nodes.strong(text=f"{title}: ")
            for row, name in enumerate(names):
                line += nodes.literal(text=name)
                line += nodes.Text(", " if row + 1 < len(names) else "")
            paragraphs += [line] if names else []
        return paragraphs


def _write_api(app: Sphinx) -> None:
    """Writes a page for each package with its modules, and a page for each public class."""
    folder = _HERE / "api"
    folder.mkdir(exist_ok=True)
    pages: dict[str, str] = {}
    # An editable install has this package outside the folder of drake_oa, where no walk finds it.
    packages = {"drake_oa.diagrams"}
    for info in pkgutil.walk_packages(drake_oa.__path__, "drake_oa."):
        # Commands have their help in the terminal; methods of the results are in results/method.
        if info.ispkg and not {"models", "app", "evaluation"} & set(info.name.split(".")):
            packages.add(info.name)
    for package in sorted(packages):
        path = importlib.import_module(package).__path__
        text = f"{package}\n{'=' * len(package)}\n\n.. automodule:: {package}\n   :no-members:\n\n"
        for name in [m.name for m in pkgutil.iter_modules(path) if not m.ispkg]:
            module = f"{package}.{name}"
            classes = _public_classes(module)
            text += f"{name}\n{'-' * len(name)}\n\n.. automodule:: {module}\n"
            text += f"   :exclude-members: {', '.join(classes)}\n\n" if classes else "\n"
            for each, summary in classes.items():
                text += f"- :py:class:`~{module}.{each}`: {summary}\n"
                pages[f"{module}.{each}"] = (
                    f":orphan:\n\n{each}\n{'=' * len(each)}\n\n"
                    f"In :py:mod:`{package}`, module `{name}`.\n\n.. autoclass:: {module}.{each}\n"
                )
            text += "\n"
        pages[package] = text
    toc = "\n".join(f"   {package}" for package in sorted(packages))
    title = "API\n===\n\nOne package per layer, and a page for each class with its ports.\n"
    pages["index"] = f"{title}\n.. toctree::\n   :maxdepth: 1\n\n{toc}\n"
    for name, page in pages.items():
        _write_if_changed(folder / f"{name}.rst", page)
    for file in folder.glob("*.rst"):
        if file.stem not in pages:
            file.unlink()


def _public_classes(module: str) -> dict[str, str]:
    """Returns names and summaries of the public classes that a module defines, in order."""
    classes = {}
    for name, member in vars(importlib.import_module(module)).items():
        if isinstance(member, type) and member.__module__ == module and not name.startswith("_"):
            paragraph = (inspect.getdoc(member) or "").partition("\n\n")[0]
            classes[name] = " ".join(paragraph.split()).replace("|", "\\|")
    return classes


def _write_gallery(app: Sphinx) -> None:
    """Writes a page with every shipped scenario, its description and its recording."""
    text = (
        "# Gallery\n\nYou will be able to select a shipped scenario and to run it.\n\n"
        "```sh\ndrake-oa run tabletop_irregular --meshcat\n```\n\n"
        "```text\nviewer: http://localhost:8000\n...\n```\n\n"
        "This address shows the avoiding motion in a browser; with a robot, "
        "`drake-oa play NAME` adds controls. Each recording on this page shows the avoiding motion "
        "of a shipped scenario. `gen3_*` and `ur5e_*` need `pip install 'drake_oa[robots]'`.\n"
    )
    for name, file in shipped_scenarios().items():
        text += f"\n## {name}\n\n{description(file)}\n"
        recording = _HERE / "results" / "recordings" / f"{name}.webp"
        if recording.is_file():
            text += f"\n![{name}](results/recordings/{name}.webp)\n"
    _write_if_changed(_HERE / "gallery.md", text)


def _write_if_changed(file: Path, text: str) -> None:
    """Writes a file unless it has this text; Sphinx reads unchanged pages from its cache."""
    if not file.is_file() or file.read_text("utf-8") != text:
        file.write_text(text, "utf-8")


def _convert_docstring(
    app: Sphinx, what: str, name: str, subject: object, options: object, lines: list[str]
) -> None:
    """Converts the lines of a docstring, written for the source, to reStructuredText in place.

    Bars, as in norms, are escaped. An indented block below a paragraph, such as a formula or a
    table, becomes literal.
    """
    result: list[str] = []
    is_literal = False
    is_plain = what == "module" and not any(line.startswith(("..", ":", "==")) for line in lines)
    for line in lines:
        last = next((each for each in reversed(result) if each), "")
        is_below = bool(result) and not result[-1]
        is_block = line.startswith("    ") and (is_plain or is_below) and last != ""
        if is_block and not is_literal and not is_below and last.startswith(("In:", "Out:")):
            result[-1] = f"{last} {line.strip()}"
            continue
        if is_block and not is_literal and not last.startswith((" ", "- ", "..", ":")):
            result += [] if last.endswith("::") else ["", "::"]
            result.append("")
            is_literal = True
        elif is_literal and line and not line.startswith(" "):
            result += ["", ""]
            is_literal = False
        result.append(line if is_literal else line.replace("|", "\\|"))
    lines[:] = result


def setup(app: Sphinx) -> None:
    """Registers the directive and the generated pages."""
    app.add_directive("pydrake_system", PydrakeSystem)
    app.connect("autodoc-process-docstring", _convert_docstring)
    app.connect("builder-inited", _write_api)
    app.connect("builder-inited", _write_gallery)
