"""Sphinx: `make docs`. The API's pages are made from the modules, see `_write_api`."""

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
version = release = installed_version("drake_oa")
# myst_nb is myst_parser, and runs the tutorials.
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
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
# A tutorial runs whenever its page is read, in a folder of its own, and fails the build if a cell
# does. The first run on a machine compiles the kernels.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 900
nb_execution_raise_on_error = True
default_role = "code"
html_theme = "furo"
html_title = "drake_oa"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
exclude_patterns = ["_build", "jupyter_execute"]
# Code in comments and results pages is highlighted as far as it goes; what Drake documents is not
# looked up, and what a page says twice is no fault.
suppress_warnings = ["misc.highlighting_failure", "myst.header", "ref.python"]

_HERE = Path(__file__).parent


class PydrakeSystem(Directive):
    """Drake's port lists, drawn as two columns of names."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        ports = yaml.safe_load("\n".join(self.content)) or {}
        found: list[nodes.Node] = []
        for key, title in (("input_ports", "Input ports"), ("output_ports", "Output ports")):
            names = [str(name) for name in ports.get(key) or ()]
            line = nodes.paragraph()
            line += nodes.strong(text=f"{title}: ")
            for row, name in enumerate(names):
                line += nodes.literal(text=name)
                line += nodes.Text(", " if row + 1 < len(names) else "")
            found += [line] if names else []
        return found


def _write_api(app: Sphinx) -> None:
    """A page for each package: what it says of itself, then its modules."""
    folder = _HERE / "api"
    folder.mkdir(exist_ok=True)
    packages = []
    for found in pkgutil.walk_packages(drake_oa.__path__, "drake_oa."):
        # Commands explain themselves in the terminal; how results come about is in results/method.
        if found.ispkg and not {"models", "app", "evaluation"} & set(found.name.split(".")):
            packages.append(found.name)
    for package in packages:
        path = __import__(package, fromlist=["_"]).__path__
        names = [m.name for m in pkgutil.iter_modules(path) if not m.ispkg]
        text = f"{package}\n{'=' * len(package)}\n\n.. automodule:: {package}\n   :no-members:\n\n"
        for name in names:
            text += f"{name}\n{'-' * len(name)}\n\n.. automodule:: {package}.{name}\n\n"
        _keep(folder / f"{package}.rst", text)
    toc = "\n".join(f"   {package}" for package in packages)
    title = "API\n===\n\nA folder a layer; ports, shapes, units and errors are in the docstrings.\n"
    _keep(folder / "index.rst", f"{title}\n.. toctree::\n   :maxdepth: 1\n\n{toc}\n")


def _write_gallery(app: Sphinx) -> None:
    """A page with every shipped scenario, its words and its recording."""
    text = "# Gallery\n\nBy `drake-oa run NAME --meshcat`; with a robot, `drake-oa play NAME`.\n"
    for name, file in shipped_scenarios().items():
        text += f"\n## {name}\n\n{description(file)}\n"
        recording = _HERE / "results" / "recordings" / f"{name}.webp"
        if recording.is_file():
            text += f"\n![{name}](results/recordings/{name}.webp)\n"
    _keep(_HERE / "gallery.md", text)


def _keep(file: Path, text: str) -> None:
    """Writes what has changed only: sphinx reads the rest from its cache."""
    if not file.is_file() or file.read_text("utf-8") != text:
        file.write_text(text, "utf-8")


def _plain_text(
    app: Sphinx, what: str, name: str, subject: object, options: object, lines: list[str]
) -> None:
    """What is written to be read in the source, as reStructuredText takes it.

    A bar is a norm, and no substitution; an indented table below a line is kept as it stands.
    """
    found: list[str] = []
    kept = False
    plain = what == "module" and not any(line.startswith(("..", ":", "==")) for line in lines)
    for line in lines:
        below = found[-1] if found else ""
        indented = line.startswith("    ") and plain
        if indented and not kept and below.startswith(("In:", "Out:")):
            found[-1] = f"{below} {line.strip()}"
            continue
        if indented and not kept and below and not below.startswith((" ", "- ")):
            found += [] if below.endswith("::") else ["", "::"]
            found.append("")
            kept = True
        elif kept and line and not line.startswith(" "):
            found += ["", ""]
            kept = False
        found.append(line if kept else line.replace("|", "\\|"))
    lines[:] = found


def setup(app: Sphinx) -> None:
    app.add_directive("pydrake_system", PydrakeSystem)
    app.connect("autodoc-process-docstring", _plain_text)
    app.connect("builder-inited", _write_api)
    app.connect("builder-inited", _write_gallery)
