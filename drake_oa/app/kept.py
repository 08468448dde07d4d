"""`drake-oa evaluate kept`: draws what evaluations of the whole robot asked for and kept."""

from __future__ import annotations

from pathlib import Path

from drake_oa.common.files import check_outputs, replace_file

FORMATS = (".pdf", ".png", ".svg")


def kept(folders: tuple[Path, ...], /, *, plot: Path, method: str = "verified") -> None:
    """Draw asked against kept clearance of `evaluate panda` and `mbm`, a panel a suite.

    For example, what a change has changed:

        drake-oa evaluate kept before after --plot kept.png

    Args:
        folders: results, scene by scene, as --results names them; each has a colour, and its name
            in the legend. At most four.
        plot: the picture, .png, .svg or .pdf.
        method: whose results.
    """
    if not 1 <= len(folders) <= 4:
        raise ValueError(f"one to four folders of results are drawn, not {len(folders)}")
    if plot.suffix not in FORMATS:
        raise ValueError(f"--plot must end in {', '.join(FORMATS)}, not {plot.name!r}")
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"{folder} is no folder of results")
    check_outputs(plot)
    from drake_oa.studies.kept import draw_kept, read_kept

    runs = {folder.name: read_kept(folder, method) for folder in folders}
    if len(runs) < len(folders):
        raise ValueError("the folders need names of their own: they are the legend")
    figure = draw_kept(runs)
    kind = plot.suffix.removeprefix(".")
    replace_file(plot, lambda path: figure.savefig(path, format=kind, dpi=130))
    print(f"plot: {plot}")
