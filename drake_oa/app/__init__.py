"""Commands of the command line `drake-oa`, one function for each command.

Inputs: scenarios by name or file, logs, depth images, options. Outputs: tables on stdout; messages,
progress and errors on stderr; the files that options name. The package cyclopts derives the options
of a command from the signature of its function, and the help text for users from the docstring.

    run                 the nominal and the avoiding motion of a scenario, with a report, a log and
                        a recording
    play                an interactive run in a browser
    station             a simulated arm that communicates by the messages of the real one
    replay, plot        replay and plot of a log
    export              conversion of a log to a bag of ROS 2 messages
    scenarios, new      the shipped scenarios, and a new one
    check, graph        the errors and the diagram of a scenario
    perceive            table, clusters and ellipsoids of recorded frames
    benchmark           real-time factors, and wall times of systems (`drake_oa.benchmark`)
    evaluate            methods on suites of scenes (`drake_oa.evaluation`): of a point, or of the
                        robot in random scenes (`panda`), in problems of MotionBenchMaker (`mbm`)
                        or with one source of motions left out (`sources`); and the tables and
                        figures of Pairet et al., RA-L 2019 (`paper_tables`)
    train               training of the networks (`drake_oa.training`)

The module of a command is imported when the command is called, and numerical packages when they are
needed: `--help` and `scenarios` import neither NumPy nor Drake. On a terminal rich formats tables
and progress; elsewhere they are plain text (`drake_oa.common.console`).

Exit statuses: 0 success; 1 failure (for example an avoiding motion that missed the goal or was in
contact, an image without a table, or a file that could not be written); 2 invalid input, reported
in one line "drake-oa: error: ..." (with --verbose after a traceback); 130 interrupted by Ctrl-C (0
for `play` and `station`, because this is their usual end); 143 terminated by SIGTERM or SIGHUP.

Begin with `main.main`.
"""
