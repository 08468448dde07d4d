"""The command `drake-oa play`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from drake_oa.app.run import reserved_log, stop_between_steps
from drake_oa.app.scenarios import Overrides, ScenarioName, build_errors, scenario_name
from drake_oa.common.files import check_outputs


def play(
    scenario: ScenarioName = "tabletop_box",
    /,
    *,
    overrides: Overrides = (),
    log: Path | None = None,
    no_log: bool = False,
) -> int:
    """Play with a scenario in the browser: change what is asked while the arm moves.

    The arm goes to the goal and back, at real time. In the panel at the upper right (Open
    Controls):

      asked clearance    how far hand and fingers are to stay away
      kept clearance     how near the arm is now to an obstacle; a line shows where
      speed              1 is real time
      goal x, y, z       where it goes to
      NAME x, y, yaw     where each obstacle stands
      throw it in        a ball comes into the way, and leaves again
      next ...           who decides: verified (the default), the paper's chain, or nobody
      camera or ...      obstacles as the camera sees them, or their true shapes
      pause, step, reset, stop

    The last line of the panel says who decides, what is seen, and what holds the motion. A
    change is taken over when the slider rests; the motion then begins again where the arm is.

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
    from drake_oa.scenario.loading import load_scenario, scenario_files, scenario_path
    from drake_oa.viewing.viewer import start_viewer

    if log is not None and no_log:
        raise ValueError("--log and --no-log exclude each other")
    chosen = load_scenario(scenario, overrides)
    check_outputs(log, read=[scenario_path(scenario), *scenario_files(chosen)])
    with build_errors():
        contacts = end_contacts(chosen)
    if contacts:
        raise ValueError(contacts)
    with (
        build_errors(),
        nullcontext() if no_log else reserved_log(log, f"{scenario_name(scenario)}_played") as file,
        stop_between_steps() as raise_if_asked,
    ):
        session = PlaySession(chosen, start_viewer(announce=True))
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
