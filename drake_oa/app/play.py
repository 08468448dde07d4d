"""The command `drake-oa play`."""

from __future__ import annotations

from pathlib import Path

from drake_oa.app.run import reserved_log, stop_between_steps
from drake_oa.app.scenarios import (
    Overrides,
    ScenarioName,
    build_errors,
    open_scenario,
    scenario_name,
)


def play(
    scenario: ScenarioName = "tabletop_box",
    /,
    *,
    overrides: Overrides = (),
    log: Path | None = None,
    no_log: bool = False,
) -> int:
    """Play with a scenario in the browser: change the request while the arm moves.

    The arm goes to the goal and back, at real time. The controls are at the upper right:

      pause, reset, stop
      next ...           method: verified (the default), the paper's chain, or nominal
      camera or ...      obstacles as the camera sees them, or their true shapes
      speed              1 is real time
      clearance          requested for hand and fingers
      goal x, y, z       where it goes to
      NAME: x, y, yaw    a folder for each obstacle: where it stands

    The panel at the lower left shows time, method, clearances, contacts, and what holds the
    motion. A change is taken over when the slider rests; the motion then begins again where the
    arm is. What cannot be is refused: the sliders go back, and the panel says why.

    The newest 20 motions go into one log, as `drake-oa run` writes it: leg_1, leg_2 and so on
    are what `drake-oa replay --motion` and `drake-oa plot` call them.

    Args:
        scenario: a shipped name (see `drake-oa scenarios`) or a file.
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        log: write the log here, in place of an earlier one.
        no_log: write no log.
    """
    from drake_oa.runs.motion_log import save_logs
    from drake_oa.runs.play import PlaySession
    from drake_oa.runs.scenario_check import end_contacts
    from drake_oa.viewing.viewer import open_page, start_viewer

    chosen = open_scenario(scenario, overrides, log)
    with build_errors():
        contacts = end_contacts(chosen)
    if contacts:
        raise ValueError(contacts)
    with (
        build_errors(),
        reserved_log(log, no_log, f"{scenario_name(scenario)}_played") as file,
        stop_between_steps() as raise_if_asked,
    ):
        viewer = start_viewer(browser=True)
        page = open_page(viewer, scenario_name(scenario), chosen.description)
        session = PlaySession(chosen, viewer, page)
        try:
            session.run(raise_if_asked)
        except KeyboardInterrupt:
            pass
        finally:
            logs = session.finish()
            if file is not None:
                save_logs(file, logs)
                print(f"log: {file}")
    return 0
