"""Command `drake-oa play`: an interactive run of a scenario in a browser, with a movable goal and
obstacles.
"""

from __future__ import annotations

from pathlib import Path

from drake_oa.app.run import reserved_log, stop_between_steps
from drake_oa.app.scenarios import (
    Overrides,
    ScenarioName,
    build_errors,
    check_end_contacts,
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
    """Move goal and obstacles of a scenario in a browser, and change the requested clearance.

    The arm moves to the goal and back, in real time. The controls are at the upper right:

      pause, reset, stop      pause the simulation; restart at the start; end the run
      next method             verified (the default: motions are verified by simulation before
                              they are executed), paper (the method of Pairet et al., RA-L 2019),
                              or nominal, which avoids nothing
      camera or ground truth  source of the obstacles: the camera, or their true shapes
      speed                   simulated time over wall time; 1 is real time
      clearance [m]           requested clearance of hand and fingers
      goal x, y, z [m]        position of the goal
      NAME: x, y, yaw         position [m] and yaw [rad] of an obstacle, in a folder of its name

    The panel at the lower left shows time, method, minimum clearances, contacts, and the reason if
    the motion is held (stopped on its path). A change becomes active when the slider has rested for
    0.3 s: a new motion starts at the present configuration. Invalid settings are refused: the
    sliders return to the previous values, and the panel shows the reason.

    The last 20 motions are written to one log, as motions leg_1, leg_2 and so on for
    `drake-oa replay --motion` and `drake-oa plot`.

    Args:
        scenario: name of a shipped scenario (see `drake-oa scenarios`), or a file.
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        log: write the log to this file, which is replaced if it exists.
        no_log: write no log.
    """
    from drake_oa.runs.motion_log import save_logs
    from drake_oa.runs.play import PlaySession
    from drake_oa.viewing.viewer import open_page, start_viewer

    loaded_scenario = open_scenario(scenario, overrides, log)
    check_end_contacts(loaded_scenario)
    with (
        reserved_log(log, no_log, f"{scenario_name(scenario)}_played") as file,
        stop_between_steps() as raise_if_requested,
    ):
        viewer = start_viewer(browser=True)
        page = open_page(viewer, scenario_name(scenario), loaded_scenario.description)
        with build_errors():
            session = PlaySession(loaded_scenario, viewer, page)
        try:
            session.run(raise_if_requested)
        except KeyboardInterrupt as error:
            # Ctrl-C is the usual end of a session.
            return getattr(error, "status", 0)
        finally:
            logs = session.finish()
            if file is not None:
                save_logs(file, logs)
                print(f"log: {file}")
    return 0
